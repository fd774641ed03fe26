//! A line of the inverse, from where the last moments lead to this one's: steps of the fixed point, four nodes at a time.
//!
//! v ← −u(x + v), at first from where the last two moments' v lead in a straight line, then from the last v, thirty-two nodes after the same number of
//! steps. A node is settled when its last step is at most `stop`. Index units of the grid; fields are whole numbers with a scale.

use maille_displacement::Nodes;
use maille_displacement::quads::{Quads, Task};

/// Nodes that take their steps together.
const CHUNK: usize = 8;
/// Steps before nodes are left to slower kernels: from rest at q = 0.4, half a millimetre in a thousandth of the longest vector.
const STEPS: usize = 8;

/// What is to be done to a line.
pub(super) struct Follow<'a> {
    /// u in steps of `scale`
    pub field: &'a Nodes<'a, i16>,
    /// j and k
    pub line: [usize; 2],
    pub scale: f32,
    /// largest last step, and what makes steps comparable, along each axis
    pub stop: [f32; 3],
    pub weight: [f32; 3],
    /// the last v, and the one before it, which the new one takes the place of; and their scales
    pub last: &'a [[i16; 4]],
    pub before: &'a mut [[i16; 4]],
    pub scales: [f32; 2],
}

/// What became of it.
pub(super) struct Followed {
    pub evaluations: u64,
    /// nodes that are not settled, and their v [index]
    pub open: Vec<(usize, [f32; 4])>,
    /// longest last step of the settled ones, weighted
    pub longest_step: f32,
}

/// Four nodes from `i` on; the last one again beyond the end.
#[inline(always)]
pub(super) fn four<T: Copy>(row: &[[T; 4]], i: usize) -> [[T; 4]; 4] {
    match row.get(i..).and_then(|rest| rest.first_chunk::<4>()) {
        Some(nodes) => *nodes,
        None => std::array::from_fn(|n| row[(i + n).min(row.len() - 1)]),
    }
}

/// Puts as many of four nodes back as there are.
#[inline(always)]
pub(super) fn put(row: &mut [[i16; 4]], i: usize, nodes: &[[i16; 4]; 4]) {
    match row.get_mut(i..).and_then(|rest| rest.first_chunk_mut::<4>()) {
        Some(place) => *place = *nodes,
        None => row[i..].iter_mut().zip(nodes).for_each(|(place, node)| *place = *node),
    }
}

impl Task for Follow<'_> {
    type Output = Followed;

    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Followed {
        let count = self.last.len();
        let [j, k] = self.line.map(|n| n as f32);
        let ramp = q.load(&[[0.0; 4], [1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0]]);
        let (twice, once) = (q.splat(2.0 * self.scales[0]), q.splat(-self.scales[1]));
        let (back, to_steps) = (q.splat(-self.scale), q.splat(1.0 / self.scale));
        let ([sx, sy, sz], [wx, wy, wz]) = (self.stop, self.weight);
        let (stop, weight) = (q.each([sx, sy, sz, 0.0]), q.each([wx, wy, wz, 0.0]));
        let mut found = Followed { evaluations: 0, open: Vec::new(), longest_step: 0.0 };
        let mut longest = q.splat(0.0);
        let mut first = 0;
        while first < count {
            let fours = (count - first).div_ceil(4).min(CHUNK);
            let (mut v, mut off) = ([q.splat(0.0); CHUNK], [q.splat(0.0); CHUNK]);
            let mut most = q.splat(0.0);
            let (mut node, four_on) = (q.add(q.each([first as f32, j, k, 0.0]), ramp), q.each([4.0, 0.0, 0.0, 0.0]));
            for n in 0..fours {
                let i = first + 4 * n;
                let lead = q.fma(q.load_narrow(&four(self.last, i)), twice, q.mul(q.load_narrow(&four(self.before, i)), once));
                v[n] = q.mul(self.field.value(q, node, lead), back);
                node = q.add(node, four_on);
                off[n] = q.abs(q.sub(v[n], lead));
                most = q.max(most, off[n]);
            }
            let mut steps = 1;
            while q.all_within(most, stop) != 0b1111 && steps < STEPS {
                steps += 1;
                most = q.splat(0.0);
                for n in 0..fours {
                    let node = q.add(q.each([(first + 4 * n) as f32, j, k, 0.0]), ramp);
                    let next = q.mul(self.field.value(q, node, v[n]), back);
                    off[n] = q.abs(q.sub(next, v[n]));
                    v[n] = next;
                    most = q.max(most, off[n]);
                }
            }
            found.evaluations += (steps * (count - first).min(4 * fours)) as u64;
            let settled = q.all_within(most, stop) == 0b1111;
            for n in 0..fours {
                let i = first + 4 * n;
                if settled {
                    longest = q.max(longest, off[n]);
                } else {
                    let within = q.all_within(off[n], stop);
                    let (mut each, mut offs) = ([[0.0; 4]; 4], [[0.0; 4]; 4]);
                    q.store(v[n], &mut each);
                    q.store(off[n], &mut offs);
                    for m in 0..4.min(count - i) {
                        if within >> m & 1 == 0 {
                            found.open.push((i + m, each[m]));
                        } else {
                            found.longest_step = (0..3).fold(found.longest_step, |l, c| l.max(offs[m][c] * self.weight[c]));
                        }
                    }
                }
                let mut nodes = [[0; 4]; 4];
                q.store_narrow(q.mul(v[n], to_steps), &mut nodes);
                put(self.before, i, &nodes);
            }
            first += 4 * fours;
        }
        let mut each = [[0.0; 4]; 4];
        q.store(q.mul(longest, weight), &mut each);
        found.longest_step = each.iter().flatten().fold(found.longest_step, |l, c| l.max(*c));
        found
    }
}
