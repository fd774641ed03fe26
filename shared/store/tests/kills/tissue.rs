//! Tissue that can be checked: every brick carries the epoch, its id, the transaction that wrote it and a checksum; the state
//! block says which transaction wrote each brick last. So one look at a snapshot tells torn bricks from whole ones, and one
//! consistent state from a mixture of two.

use maille_store::{Cuts, DISPLACEMENT_LEN, Plastic, STATE_BYTES, Snapshot, StoreSizes, Transaction};
use maille_volume::{Brick, BrickSource, Grid, Rescale, Volume};

/// Voxels along each axis.
pub const SIZE: usize = 80;
/// Bricks of the volume.
pub const BRICKS: usize = 125;
/// Most bricks that one transaction changes.
pub const DIRTY: u64 = 24;

/// Room for one version of every brick, another that one stopped reader holds, and a transaction: with eight it runs out now and then.
pub const SIZES: StoreSizes = sizes(2 * BRICKS + 2 * DIRTY as usize, 2 * BRICKS + DIRTY as usize);

/// Every channel that a deforming tissue has.
pub const fn sizes(spare_slots: usize, displacement_slots: usize) -> StoreSizes {
    StoreSizes {
        spare_slots,
        displacement_slots,
        plastic_slots: displacement_slots,
        cut_slots: displacement_slots,
        label_slots: 0,
        octree_slots: 0,
    }
}

/// The volume at rest.
pub fn volume() -> Volume {
    let grid = Grid::axis_aligned([SIZE; 3], [1.0; 3]);
    let voxels = (0..grid.voxel_count()).map(|n| (n % 1999) as i16 - 1000).collect();
    Volume::new(grid, Rescale { slope: 1.0, intercept: 0.0 }, voxels)
}

/// splitmix64: a seed gives one sequence, everywhere.
#[derive(Clone)]
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 ≤ … < n.
    pub fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
}

/// What is wrong with a snapshot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Wrong {
    /// a brick is not as one transaction wrote it
    Torn = 1,
    /// parts of different states
    Mixed = 2,
}

/// The state block: what was committed last, and by which transaction each brick and its displacement were written (0: never).
#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
pub struct State {
    pub transaction: u64,
    pub epoch: u64,
    bricks: [u32; BRICKS],
    displacements: [u32; BRICKS],
}

impl State {
    pub fn of(block: &[u8; STATE_BYTES]) -> Self {
        bytemuck::pod_read_unaligned(&block[..size_of::<Self>()])
    }
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Label {
    epoch: u64,
    id: u64,
    transaction: u64,
    checksum: u64,
}

const LABEL: usize = size_of::<Label>();

fn checksum(bytes: &[u8], label: &Label) -> u64 {
    let step = |h: u64, word: u64| (h ^ word).wrapping_mul(0x0100_0000_01B3).rotate_left(23);
    let words = bytes.chunks(8).map(|c| c.iter().rev().fold(0, |word, &b| word << 8 | u64::from(b)));
    [label.epoch, label.id, label.transaction].into_iter().chain(words).fold(0xCBF2_9CE4_8422_2325, step)
}

/// Does what the transaction of that number does, the same whoever does it: a few bricks, some displacements, the state.
pub fn change(t: &mut Transaction<'_>, seed: u64, transaction: u64, epoch: u64) {
    let mut random = Random(seed ^ transaction.wrapping_mul(0xD134_2543_DE82_EF95));
    let mut state = State::of(t.state_mut());
    for _ in 0..1 + random.below(DIRTY) {
        let id = random.below(BRICKS as u64);
        let bytes = bytemuck::bytes_of_mut(&mut t.brick_mut(id as u32).voxels);
        let (label, rest) = bytes.split_at_mut(LABEL);
        let mut fill = Random(transaction << 8 ^ id);
        let word = fill.next().to_le_bytes();
        rest.chunks_mut(8).for_each(|chunk| chunk.copy_from_slice(&word[..chunk.len()]));
        // a few words that differ, so that a brick is not one word repeated
        for _ in 0..16 {
            let at = fill.below(rest.len() as u64) as usize;
            rest[at] ^= fill.next() as u8;
        }
        let mut new = Label { epoch, id, transaction, checksum: 0 };
        new.checksum = checksum(rest, &new);
        label.copy_from_slice(bytemuck::bytes_of(&new));
        state.bricks[id as usize] = transaction as u32;
        if random.below(3) == 0 {
            let value = displacement(transaction, id);
            t.displacement_mut(id as u32).fill(value);
            t.channel_mut::<Plastic>(id as u32).fill(-value);
            t.channel_mut::<Cuts>(id as u32).fill(transaction as u8);
            state.displacements[id as usize] = transaction as u32;
        }
    }
    (state.transaction, state.epoch) = (transaction, epoch);
    t.state_mut()[..size_of::<State>()].copy_from_slice(bytemuck::bytes_of(&state));
}

fn displacement(transaction: u64, id: u64) -> f32 {
    ((transaction * 128 + id) % (1 << 23)) as f32
}

/// Looks at everything that a snapshot shows.
pub fn check(snapshot: &Snapshot<'_>, rest: &impl BrickSource) -> Result<State, (Wrong, String)> {
    let epoch = snapshot.epoch();
    let state = State::of(snapshot.state());
    if state.transaction != 0 && state.epoch != epoch {
        return Err((Wrong::Mixed, format!("the state of epoch {} in a snapshot of epoch {epoch}", state.epoch)));
    }
    for id in 0..BRICKS {
        check_voxels(snapshot, &state, id, rest)?;
        let moved: Option<&[f32; DISPLACEMENT_LEN]> = snapshot.displacement(id as u32);
        let by = u64::from(state.displacements[id]);
        match moved {
            None if by == 0 => {}
            Some(values) if by != 0 => {
                let first = values[0];
                if values.iter().any(|&v| v != first) {
                    return Err((Wrong::Torn, format!("epoch {epoch}: the displacement of brick {id} is torn")));
                }
                let plastic = snapshot.channel::<Plastic>(id as u32).is_some_and(|p| p.iter().all(|&v| v == -first));
                let cuts = snapshot.channel::<Cuts>(id as u32).is_some_and(|c| c.iter().all(|&v| v == by as u8));
                if first != displacement(by, id as u64) || !plastic || !cuts {
                    return Err((
                        Wrong::Mixed,
                        format!("epoch {epoch}: displacement, plastic part and cuts of brick {id} are not of transaction {by}"),
                    ));
                }
            }
            _ => return Err((Wrong::Mixed, format!("epoch {epoch}: brick {id} has a displacement, or none, against its state"))),
        }
    }
    Ok(state)
}

/// Looks at the bricks of the newest transaction only, the last written first: a few microseconds, so that whoever sees an epoch as it
/// appears looks while a commit that is not atomic would still be at work.
pub fn check_newest(snapshot: &Snapshot<'_>, rest: &impl BrickSource) -> Result<(), (Wrong, String)> {
    let state = State::of(snapshot.state());
    let newest = (0..BRICKS).rev().filter(|&id| state.transaction > 0 && u64::from(state.bricks[id]) == state.transaction);
    newest.take(4).try_for_each(|id| check_voxels(snapshot, &state, id, rest))
}

fn check_voxels(snapshot: &Snapshot<'_>, state: &State, id: usize, rest: &impl BrickSource) -> Result<(), (Wrong, String)> {
    let epoch = snapshot.epoch();
    let brick: &Brick = snapshot.brick(id as u32);
    let written = u64::from(state.bricks[id]);
    if written == 0 {
        if !std::ptr::eq(brick, rest.brick(id as u32)) {
            return Err((Wrong::Mixed, format!("epoch {epoch}: brick {id} has a version that its state does not know")));
        }
        return Ok(());
    }
    let (label, bytes) = bytemuck::bytes_of(&brick.voxels).split_at(LABEL);
    let label: Label = bytemuck::pod_read_unaligned(label);
    if label.checksum != checksum(bytes, &label) || label.id != id as u64 {
        return Err((Wrong::Torn, format!("epoch {epoch}: brick {id} of transaction {written} is torn")));
    }
    if label.transaction != written || label.epoch > epoch || label.epoch > snapshot.stamp(id as u32) {
        let says = format!("brick {id} of transaction {} and epoch {}, not of {written}", label.transaction, label.epoch);
        return Err((Wrong::Mixed, format!("epoch {epoch}: {says}")));
    }
    Ok(())
}
