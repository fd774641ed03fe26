//! What the tissue allows, from its CT values [Dräger 2005, 3.5.5, 3.6.2 and 4.6].
//!
//! v = clamp(HU + 1000, 0, 4095), softness = 1 − (v/4096)²; offset o = offset · softness, movement limit m = mc · softness.
//! (Chapter 7 of the thesis prints the scaling reversed; 3.6.2 is right: dense tissue is stiff.)

use wide::f32x4;

/// How the admissible part of a push is chosen where bone, border or the movement limit refuse some of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Admission {
    /// the largest part of the push along its own direction
    #[default]
    Scaled,
    /// each component as far as it can go: slides along what refuses it
    ByComponent,
}

/// Parameters of the tissue; the same for the whole volume, applied to each voxel's CT value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tissue {
    /// chain region's offset o, as a fraction of the spacing; below 1/3 the deformation is one-to-one
    pub offset: f32,
    /// whether denser tissue is stiffer, o_eff = offset · softness
    pub density_scaling: bool,
    /// links run only between voxels of at least this value [HU]; `None`: all links exist
    pub threshold_hu: Option<f64>,
    /// voxels of at least this value [HU] never move; `None`: no bone
    pub bone_hu: Option<f64>,
    /// bound mc on each component of u [mm], scaled by softness; `None`: no bound
    pub movement_limit_mm: Option<f32>,
    /// what is done with the part of a push that is refused
    pub admission: Admission,
}

impl Default for Tissue {
    fn default() -> Self {
        Self {
            offset: 0.2,
            density_scaling: true,
            threshold_hu: None,
            bone_hu: Some(300.0),
            movement_limit_mm: None,
            admission: Admission::Scaled,
        }
    }
}

/// What the parameters make of one voxel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ElementLimits {
    /// offset o; infinite in a void: a link that does not exist is a link without a limit
    pub offset: f32,
    /// bound on |u_c| [mm]: 0 on bone, infinite without movement limit
    pub bound: f32,
}

impl Tissue {
    /// Why these parameters cannot be used, if they cannot.
    pub fn fault(&self) -> Option<String> {
        let finite = |v: Option<f64>| v.is_none_or(f64::is_finite);
        if !(self.offset > 0.0 && self.offset < 1.0) {
            return Some(format!("offset {} is not between 0 and 1", self.offset));
        }
        if !finite(self.threshold_hu) || !finite(self.bone_hu) {
            return Some("threshold and bone must be finite numbers of HU".into());
        }
        if self.movement_limit_mm.is_some_and(|m| !(m >= 0.0 && m.is_finite())) {
            return Some("the movement limit must be a finite number of mm, 0 or more".into());
        }
        None
    }

    /// 1 − (v/4096)² of a CT value.
    #[inline]
    pub fn softness(hu: f64) -> f64 {
        let v = (hu + 1000.0).clamp(0.0, 4095.0) / 4096.0;
        1.0 - v * v
    }

    /// Limits of a voxel with this CT value.
    #[inline]
    pub fn limits(&self, hu: f64) -> ElementLimits {
        let softness = Self::softness(hu);
        let offset = match self.threshold_hu {
            Some(threshold) if hu < threshold => f32::INFINITY,
            _ if self.density_scaling => (f64::from(self.offset) * softness) as f32,
            _ => self.offset,
        };
        let bound = match (self.bone_hu, self.movement_limit_mm) {
            (Some(bone), _) if hu >= bone => 0.0,
            (_, Some(limit)) => (f64::from(limit) * softness) as f32,
            _ => f32::INFINITY,
        };
        ElementLimits { offset, bound }
    }
}

/// Limit [mm] of the link between neighbours with offsets `a` and `b` along an axis of spacing `s` [mm]; infinite where
/// either is void: no link. Used by propagation and by what is written to files.
#[inline(always)]
pub fn link_limit(a: f32, b: f32, s: f32) -> f32 {
    0.5 * (a + b) * s
}

/// The same in four lanes, rounded in the same places: the same bits.
#[inline(always)]
pub fn link_limits(a: f32x4, b: f32x4, s: f32x4) -> f32x4 {
    f32x4::splat(0.5) * (a + b) * s
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_in_lanes_have_the_bits_of_single_ones() {
        let (a, b) = ([0.2, 0.013, f32::INFINITY, 0.3333], [0.1999, 0.2, 0.1, 0.0]);
        let lanes = link_limits(f32x4::new(a), f32x4::new(b), f32x4::splat(0.7)).to_array();
        assert_eq!(lanes, std::array::from_fn(|n| link_limit(a[n], b[n], 0.7)));
    }

    #[test]
    fn dense_tissue_is_stiff_and_air_is_soft() {
        let tissue = Tissue { bone_hu: Some(400.0), movement_limit_mm: Some(10.0), ..Tissue::default() };
        assert_eq!(tissue.limits(-1024.0), ElementLimits { offset: 0.2, bound: 10.0 });
        let soft = tissue.limits(40.0);
        assert!((f64::from(soft.offset) - 0.2 * (1.0 - (1040.0f64 / 4096.0).powi(2))).abs() < 1e-7);
        assert_eq!(tissue.limits(400.0).bound, 0.0);
        assert!(tissue.limits(3000.0).offset < 0.02 * 0.2 + 0.01);
        let open = Tissue { threshold_hu: Some(-300.0), ..tissue };
        assert!(open.limits(-301.0).offset.is_infinite() && open.limits(-300.0).offset.is_finite());
        assert!(link_limit(f32::INFINITY, 0.2, 1.0).is_infinite());
    }
}
