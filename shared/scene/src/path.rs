//! From the scene's way points or approach to the way of the tip in millimetres.

/// Where the tip's centre is at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Waypoint {
    /// [s] from the start of a round
    pub time_s: f64,
    /// [mm, LPS]
    pub position_mm: [f64; 3],
    /// unit vector, shaft to tip
    pub direction: [f64; 3],
}

/// Position, velocity and direction of the tool.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ToolPose {
    /// tip's centre [mm, LPS]
    pub position_mm: [f64; 3],
    /// its velocity [mm/s]
    pub velocity_mm_s: [f64; 3],
    /// unit vector, shaft to tip
    pub direction: [f64; 3],
}

/// The volume's box of voxel centres, along the LPS axes [mm].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoxMm {
    /// smallest coordinates
    pub low: [f64; 3],
    /// largest coordinates
    pub high: [f64; 3],
}

impl BoxMm {
    /// The box that holds all voxel centres of a grid, however its axes lie.
    pub fn of(grid: &maille_volume::Grid) -> Self {
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        for corner in 0..8usize {
            let at = grid.world_from_index(std::array::from_fn(|c| if corner >> c & 1 == 1 { (grid.size[c] - 1) as f64 } else { 0.0 }));
            for c in 0..3 {
                low[c] = low[c].min(at[c]);
                high[c] = high[c].max(at[c]);
            }
        }
        Self { low, high }
    }

    /// Position of a fraction along each LPS axis.
    pub fn at(&self, fraction: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|c| self.low[c] + fraction[c] * (self.high[c] - self.low[c]))
    }

    /// Length of the box's diagonal [mm].
    pub fn diagonal(&self) -> f64 {
        (0..3).map(|c| (self.high[c] - self.low[c]).powi(2)).sum::<f64>().sqrt()
    }
}
