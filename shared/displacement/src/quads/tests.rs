use super::*;
use crate::{Nodes, trilinear};

const SIZE: [usize; 3] = [9, 7, 6];

fn nodes() -> Vec<[i16; 4]> {
    (0..SIZE.iter().product::<usize>())
        .map(|n| std::array::from_fn(|c| if c < 3 { ((n * 7919 + c * 104_729) % 4001) as i16 - 2000 } else { 0 }))
        .collect()
}

/// u at many places, wide and narrow.
struct Ask<'a> {
    narrow: Nodes<'a, i16>,
    wide: Nodes<'a, f32>,
    places: &'a [([f32; 4], [f32; 4])],
}

impl Task for Ask<'_> {
    type Output = Vec<[[f32; 4]; 2]>;
    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Self::Output {
        let mut out = Vec::new();
        for four in self.places.chunks_exact(4) {
            let node = q.load(&[four[0].0, four[1].0, four[2].0, four[3].0]);
            let v = q.load(&[four[0].1, four[1].1, four[2].1, four[3].1]);
            let (mut narrow, mut wide) = ([[0.0; 4]; 4], [[0.0; 4]; 4]);
            q.store(self.narrow.value(q, node, v), &mut narrow);
            q.store(self.wide.value(q, node, v), &mut wide);
            for n in 0..4 {
                out.push([narrow[n], wide[n]]);
            }
        }
        out
    }
}

#[test]
fn every_width_finds_the_trilinear_value_anywhere() {
    let narrow = nodes();
    let wide: Vec<[f32; 4]> = narrow.iter().map(|n| n.map(f32::from)).collect();
    let places: Vec<([f32; 4], [f32; 4])> = (0..4000)
        .map(|n| {
            let node: [f32; 4] = std::array::from_fn(|c| if c < 3 { (n * (c + 3) % SIZE[c]) as f32 } else { 0.0 });
            // in the grid, on its nodes, a little and far beyond, and nowhere
            let far = if n % 7 == 0 { 40.0 } else { 3.0 };
            let v = std::array::from_fn(|c| if c < 3 && n % 5 != 0 { far * ((n * (2 * c + 1)) as f32 * 0.37).sin() } else { 0.0 });
            (node, if n % 101 == 100 { [f32::NAN, 0.0, 0.0, 0.0] } else { v })
        })
        .collect();
    let expected: Vec<[f32; 3]> = places
        .iter()
        .map(|(node, v)| {
            let held: [f32; 3] = std::array::from_fn(|c| {
                let at = node[c] + v[c];
                if at > 0.0 { at.min((SIZE[c] - 1) as f32) } else { 0.0 }
            });
            let low: [usize; 3] = std::array::from_fn(|c| (held[c] as usize).min(SIZE[c] - 2));
            let corners = std::array::from_fn(|n: usize| {
                let at = (low[2] + (n >> 2)) * SIZE[0] * SIZE[1] + (low[1] + (n >> 1 & 1)) * SIZE[0] + low[0] + (n & 1);
                [wide[at][0], wide[at][1], wide[at][2]]
            });
            trilinear(&corners, std::array::from_fn(|c| held[c] - low[c] as f32)).u
        })
        .collect();
    for width in Width::ALL {
        let ask = Ask { narrow: Nodes::new(&narrow, SIZE), wide: Nodes::new(&wide, SIZE), places: &places };
        for (n, (found, expected)) in run_with(width, ask).iter().zip(&expected).enumerate() {
            for c in 0..3 {
                // numbers to 2000; a place of 8 in f32 is known to 5e-7, and slopes are up to 4000
                assert!(
                    (found[0][c] - expected[c]).abs() < 1e-2 && (found[1][c] - expected[c]).abs() < 1e-2,
                    "{width:?} {n} {found:?} {expected:?}"
                );
            }
            assert_eq!(found[0], found[1], "narrow and wide nodes hold the same numbers");
        }
    }
}

/// What goes in and out of memory, and comparisons.
struct Memory;

impl Task for Memory {
    type Output = ([[i16; 4]; 4], [[f32; 4]; 4], [u32; 3], [[f32; 4]; 4]);
    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Self::Output {
        let v = q.load(&[[0.5, 1.5, -2.5, 0.49], [40_000.0, -40_000.0, 32_767.4, -7.6], [1.0; 4], [-3.0; 4]]);
        let (mut narrow, mut wide, mut half) = ([[0; 4]; 4], [[0.0; 4]; 4], [[0.0; 4]; 4]);
        q.store_narrow(v, &mut narrow);
        q.store(q.component::<2>(q.abs(q.min(q.max(v, q.splat(-9.0)), q.each([9.0, 8.0, 7.0, 6.0])))), &mut wide);
        let nan = q.load(&[[0.0; 4], [f32::NAN, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [1.0; 4]]);
        let masks = [q.all_within(nan, q.splat(1.0)), q.all_within(nan, q.splat(0.5)), q.all_within(nan, q.splat(f32::INFINITY))];
        q.store(q.load_half(&[[0x3C00, 0x0001, 0xC000, 0x8000], [0x7BFF; 4], [0x3555; 4], [0; 4]]), &mut half);
        (narrow, wide, masks, half)
    }
}

#[test]
fn every_width_rounds_saturates_and_compares_alike() {
    for width in Width::ALL {
        let (narrow, wide, masks, half) = run_with(width, Memory);
        assert_eq!(narrow, [[0, 2, -2, 0], [32_767, -32_768, 32_767, -8], [1; 4], [-3; 4]], "{width:?}");
        assert_eq!(wide, [[2.5; 4], [7.0; 4], [1.0; 4], [3.0; 4]], "{width:?}");
        // a NaN is within nothing
        assert_eq!(masks, [0b1001, 0b0001, 0b1101], "{width:?}");
        assert_eq!(half, [[1.0, 2f32.powi(-24), -2.0, 0.0], [65_504.0; 4], [0.333_251_95; 4], [0.0; 4]], "{width:?}");
    }
}

/// The largest differences of four cells.
struct Edges<'a>(&'a [[[i16; 4]; 4]; 8]);

impl Task for Edges<'_> {
    type Output = [[[f32; 4]; 4]; 3];
    #[inline(always)]
    fn run<Q: Quads>(self, q: Q) -> Self::Output {
        let [a, b, c, d, e, f, g, h] = self.0;
        let found = q.steepest(&[a, b, c, d, e, f, g, h]);
        let mut out = [[[0.0; 4]; 4]; 3];
        q.store(found[0], &mut out[0]);
        q.store(found[1], &mut out[1]);
        q.store(found[2], &mut out[2]);
        out
    }
}

#[test]
fn every_width_finds_the_steepest_edge_of_each_axis() {
    let corners: [[[i16; 4]; 4]; 8] =
        std::array::from_fn(|n| std::array::from_fn(|m| std::array::from_fn(|c| ((n * 7919 + m * 104_729 + c * 1301) % 60_001) as i16)));
    for width in Width::ALL {
        let found = run_with(width, Edges(&corners));
        for (axis, found) in found.iter().enumerate() {
            for (m, c) in (0..4).flat_map(|m| (0..4).map(move |c| (m, c))) {
                let edge = |n: usize| (i32::from(corners[n | 1 << axis][m][c]) - i32::from(corners[n][m][c])).abs().min(32_767);
                let expected = (0..8).filter(|n| n >> axis & 1 == 0).map(edge).max().unwrap();
                assert_eq!(found[m][c], expected as f32, "{width:?} {axis} {m} {c}");
            }
        }
    }
}
