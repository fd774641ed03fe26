//! What a link allows: by axis, by direction, through voids and across cuts.
//!
//! A link between neighbours p, q = p + 1 along an axis a of spacing s has the base limit ½ (o_p + o_q) · s, half of it in each
//! voxel. What it demands of component c of the displacement is
//!
//! c ≠ a (shear):  |u_c(q) − u_c(p)| ≤ f_shear · ½ (o_p + o_q) · s
//! c = a:          u_c(q) − u_c(p) ≤ w⁺ = f_extension · ½ (o_p + o_q) · s,    u_c(p) − u_c(q) ≤ w⁻ = f_compression · ½ (o_p + o_q) · s
//!
//! [Gibson 1997: maxDx, minDx and shear; Dräger 2005, 3.2]. **A void is one-sided**: it carries neither shear nor extension, and a
//! void voxel can be pressed to nothing, so that in compression its half of a link is ½ s. A gap of n voxels between
//! walls a and b then adds up to u(a) − u(b) ≤ n·s + ½ (o_a + o_b)·s: it closes until the walls touch, then the far wall is pushed,
//! and it opens freely. **A cut** is such a gap without width: only the compression of its link is left. With [`Gaps::Free`] neither
//! holds anything, and walls may pass through one another.
//!
//! **Slender tissue bends**: where the run of tissue along c through a voxel is short, its half of a link sheared along c gets an offset of its
//! own, so that a bump gives way sideways and leaves its root where it was.
//!
//! Every demand is a difference constraint on one component, so all of the crate's root holds for them as they are. The proof
//! that the map is one-to-one needs extension, compression and the shears of a cell to add up to less than 1.

/// Factors on the base limit of the links along one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisLimits {
    /// of w⁺: how far the ends may come apart
    pub extension: f32,
    /// of w⁻: how far they may come together
    pub compression: f32,
    /// of the shear of the other two components
    pub shear: f32,
}

impl Default for AxisLimits {
    fn default() -> Self {
        Self { extension: 1.0, compression: 1.0, shear: 1.0 }
    }
}

/// What voids and cuts hold.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Gaps {
    /// they close until their walls touch, and open freely
    #[default]
    OneSided,
    /// nothing
    Free,
}

/// The shape of the regions in which neighbours may move, and so of a dent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Metric {
    /// six neighbours: square dents, swept brick by brick
    #[default]
    Cubic,
    /// twenty more links to the diagonal neighbours, as long as the diagonals: rounder dents, element by element, slower
    Round,
}

/// How thin tissue shears.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Slender {
    /// a run of at most so many voxels of tissue is slender; 1 … 8
    pub thickness: u8,
    /// offset of its shear, in place of a smaller one of the tissue
    pub offset: f32,
}

/// How links depend on axis, direction, void, cut and thinness. The default is the thesis's: the same for all.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkModel {
    /// factors for the links along i, j and k
    pub axes: [AxisLimits; 3],
    /// what voids and cuts hold
    pub gaps: Gaps,
    /// which neighbours are linked
    pub metric: Metric,
    /// thin tissue, with a threshold only
    pub slender: Option<Slender>,
}

/// Bit of the link from an element towards its next along i, j or k: set when it is cut.
pub const CUT: [u8; 3] = [1, 2, 4];
/// Bits of slenderness along i, j and k, beside those of cuts.
pub(crate) const SLENDER: [u8; 3] = [8, 16, 32];

impl LinkModel {
    /// Why this model cannot be used, if it cannot.
    pub fn fault(&self) -> Option<String> {
        for axis in &self.axes {
            for factor in [axis.extension, axis.compression, axis.shear] {
                if !(factor > 0.0 && factor <= 1e3) {
                    return Some(format!("a link's factor of {factor} is not between 0 and 1000"));
                }
            }
        }
        if let Some(slender) = self.slender
            && !((1..=8).contains(&slender.thickness) && slender.offset > 0.0 && slender.offset < 1.0)
        {
            return Some("slender tissue is 1 to 8 voxels thick and its offset is between 0 and 1".into());
        }
        None
    }

    /// Whether every link allows the same in both directions and for all components, and there is no thin tissue.
    pub(crate) fn is_plain(&self) -> bool {
        self.axes == [AxisLimits::default(); 3] && self.slender.is_none()
    }
}

/// What the links along one axis demand in one direction: that the element at their end is not left behind by more than w.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rule {
    /// spacing times factor [mm]
    pub length: f32,
    /// offset that stands for a void; infinite: it holds nothing
    pub void: f32,
    /// whether a cut link holds nothing
    pub cut: bool,
    /// bit of slenderness that matters, and its offset
    pub slender: (u8, f32),
}

impl Rule {
    /// Offset of an element for this rule.
    #[inline(always)]
    pub fn offset(&self, offset: f32, flags: u8) -> f32 {
        if offset == f32::INFINITY {
            self.void
        } else if flags & self.slender.0 != 0 {
            offset.max(self.slender.1)
        } else {
            offset
        }
    }

    /// Limit [mm] of the link from (offset, flags) `low` to its next along `axis`.
    #[inline(always)]
    pub fn limit(&self, axis: usize, low: (f32, u8), high: (f32, u8)) -> f32 {
        if self.cut && low.1 & CUT[axis] != 0 {
            return f32::INFINITY;
        }
        crate::tissue::link_limit(self.offset(low.0, low.1), self.offset(high.0, high.1), self.length)
    }
}

/// The rules of one component and direction of propagation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rules {
    /// what p demands of p + 1, by axis
    pub up: [Rule; 3],
    /// what p + 1 demands of p
    pub down: [Rule; 3],
    /// lengths of the steps to all around [mm], by step along i, j, k (0 down, 1 none, 2 up), i fastest
    pub lengths: [f32; 27],
}

impl Rules {
    /// Rules for raising `sign`·u of a component.
    pub fn new(model: &LinkModel, spacing: [f32; 3], component: usize, sign: f32) -> Self {
        let rule = |axis: usize, towards: f32| {
            let factors = model.axes[axis];
            if axis != component {
                let slender = model.slender.map_or((0, 0.0), |s| (SLENDER[component], s.offset));
                return Rule { length: spacing[axis] * factors.shear, void: f32::INFINITY, cut: true, slender };
            }
            // p raises sign·u of p + 1: for sign + it presses on it
            if towards * sign > 0.0 {
                let holds = model.gaps == Gaps::OneSided;
                // the half link of a void is ½ s, whatever the factor of tissue
                let void = if holds { 1.0 / factors.compression } else { f32::INFINITY };
                Rule { length: spacing[axis] * factors.compression, void, cut: !holds, slender: (0, 0.0) }
            } else {
                Rule { length: spacing[axis] * factors.extension, void: f32::INFINITY, cut: true, slender: (0, 0.0) }
            }
        };
        let up: [Rule; 3] = std::array::from_fn(|axis| rule(axis, 1.0));
        let down: [Rule; 3] = std::array::from_fn(|axis| rule(axis, -1.0));
        let lengths = std::array::from_fn(|n| {
            let step = |axis: usize, to: usize| [down[axis].length, 0.0, up[axis].length][to];
            let squares = [step(0, n % 3), step(1, n / 3 % 3), step(2, n / 9)].map(|s| s * s);
            (squares[0] + squares[1] + squares[2]).sqrt()
        });
        Self { up, down, lengths }
    }

    /// The rule on a side (axis·2, +1 upwards).
    #[inline(always)]
    pub fn side(&self, side: usize) -> &Rule {
        if side % 2 == 1 { &self.up[side / 2] } else { &self.down[side / 2] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gap_adds_up_to_its_width_and_opens_freely() {
        let model = LinkModel { axes: [AxisLimits { compression: 0.5, ..AxisLimits::default() }; 3], ..LinkModel::default() };
        let (tissue, void) = ((0.2, 0), (f32::INFINITY, 0));
        let pressing = Rules::new(&model, [1.0, 1.0, 2.0], 2, 1.0).up[2];
        // two void voxels of 2 mm: wall, void, void, wall
        let sum = pressing.limit(2, tissue, void) + pressing.limit(2, void, void) + pressing.limit(2, void, tissue);
        assert!((sum - (2.0 * 2.0 + 0.5 * 0.2 * 2.0)).abs() < 1e-6, "{sum}");
        let pulling = Rules::new(&model, [1.0, 1.0, 2.0], 2, -1.0).up[2];
        assert!(pulling.limit(2, tissue, void).is_infinite());
        // a cut presses as before and does not pull; nor does it shear
        assert_eq!(pressing.limit(2, (0.2, CUT[2]), tissue), pressing.limit(2, tissue, tissue));
        assert!(pulling.limit(2, (0.2, CUT[2]), tissue).is_infinite());
        assert!(Rules::new(&model, [1.0; 3], 0, 1.0).up[2].limit(2, (0.2, CUT[2]), tissue).is_infinite());
    }

    #[test]
    fn raising_one_way_is_lowering_the_other() {
        let axes = [AxisLimits { extension: 0.5, compression: 2.0, shear: 0.7 }; 3];
        let model = LinkModel { axes, ..LinkModel::default() };
        for c in 0..3 {
            let (raise, lower) = (Rules::new(&model, [1.0, 2.0, 3.0], c, 1.0), Rules::new(&model, [1.0, 2.0, 3.0], c, -1.0));
            assert_eq!((raise.up, raise.down), (lower.down, lower.up));
        }
    }
}
