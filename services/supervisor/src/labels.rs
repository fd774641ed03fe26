//! Labels of the patient at rest, for a needle: those of a made patient, or of a label map beside the volume's file.
//!
//! A label map of a file names organs; what it leaves at 0, or names with a number that no row of the scene's table has, is known by its CT value. It
//! must lie on the volume's own grid: the same number of voxels, and each within [`APART`] of a voxel of where the volume has it (formats store
//! directions in different precisions). Anything else is refused: tissue a few millimetres off is worse than none.

use crate::SupervisorError;
use maille_contract::needle::{LABELS_KIND, LABELS_REGION, LabelsHeader};
use maille_phantom::{Kind, Phantom};
use maille_scene::{PhantomKind, Scene, VolumeSource};
use maille_store::{Region, StoreKeeper};
use maille_transport::Domain;
use maille_volume::{Grid, io};
use std::path::Path;

/// Part of the smallest spacing by which a label may lie off its voxel.
const APART: f64 = 0.05;

/// Whether the scene has labels at all.
fn wanted(scene: &Scene) -> bool {
    scene.has_effect("needle") && (scene.volume.file.is_none() || scene.volume.labels.is_some())
}

/// Bytes of the region of labels on this grid; 0 where there is none.
pub fn bytes(scene: &Scene, grid: &Grid) -> u64 {
    if wanted(scene) { Region::<LabelsHeader>::segment_bytes(grid.voxel_count()) as u64 } else { 0 }
}

/// A label for each voxel of the grid, i fastest; none where the scene has none.
///
/// # Errors
/// When the file cannot be read, lies on another grid, or holds numbers that are no labels.
pub fn of(scene: &Scene, grid: &Grid) -> Result<Option<Vec<u8>>, SupervisorError> {
    if !wanted(scene) {
        return Ok(None);
    }
    match (scene.volume.source(), &scene.volume.labels) {
        (VolumeSource::Phantom { kind, size, seed }, _) => {
            let kind = match kind {
                PhantomKind::Head => Kind::Head,
                PhantomKind::Torso => Kind::Torso,
            };
            Ok(Some(Phantom::new(kind, seed).labels(size)))
        }
        (VolumeSource::File(_), Some(file)) => read(file, grid).map(Some),
        (VolumeSource::File(_), None) => Ok(None),
    }
}

/// Makes the region of labels, where the scene has one.
pub fn publish(scene: &Scene, grid: &Grid, keeper: &mut StoreKeeper, domain: &Domain) -> Result<(), SupervisorError> {
    let Some(labels) = of(scene, grid)? else { return Ok(()) };
    let header = LabelsHeader { size: grid.size.map(|n| n as u64) };
    keeper.add_region(domain, LABELS_REGION, LABELS_KIND, &header, labels.len(), |to| to.copy_from_slice(&labels))?;
    Ok(())
}

fn read(path: &Path, grid: &Grid) -> Result<Vec<u8>, SupervisorError> {
    let refused = |why: String| SupervisorError::Refused(format!("the label map {} cannot be used: {why}", path.display()));
    let (map, _) = io::read_volume(path)?;
    let own = &map.info.grid;
    if own.size != grid.size {
        let [a, b] = [own.size, grid.size].map(|[i, j, k]| format!("{i} × {j} × {k}"));
        return Err(refused(format!("it has {a} voxels and the volume {b}; resample it onto the volume's grid")));
    }
    let far = off(own, grid);
    if far.is_nan() || far > APART * grid.min_spacing() {
        return Err(refused(format!("its voxels lie up to {far:.2} mm from the volume's; resample it onto the volume's grid")));
    }
    let rescale = map.info.rescale;
    let label = |v: &i16| {
        let value = rescale.value(f64::from(*v));
        let whole = value.round();
        let fits = (0.0..=255.0).contains(&whole) && (value - whole).abs() < 1e-3;
        fits.then_some(whole as u8).ok_or_else(|| refused(format!("{value} is no label; labels are whole numbers from 0 to 255")))
    };
    map.voxels.iter().map(label).collect()
}

/// How far the corners of two grids of one size lie apart, at most [mm]; between corners it is less.
fn off(a: &Grid, b: &Grid) -> f64 {
    let corner = |grid: &Grid, n: usize| {
        grid.world_from_index(std::array::from_fn(|c| if n >> c & 1 == 1 { (grid.size[c] - 1) as f64 } else { 0.0 }))
    };
    (0..8).map(|n| (corner(a, n), corner(b, n))).map(|(p, q)| (0..3).map(|c| (p[c] - q[c]).powi(2)).sum::<f64>().sqrt()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use maille_volume::{Rescale, Volume};

    /// A directory that goes with the test.
    struct Folder(std::path::PathBuf);

    impl Folder {
        fn new() -> Self {
            static COUNT: std::sync::atomic::AtomicUsize = std::sync::atomic::AtomicUsize::new(0);
            let n = COUNT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            let path = std::env::temp_dir().join(format!("maille-labels-{}-{n}", std::process::id()));
            std::fs::create_dir_all(&path).unwrap();
            Self(path)
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = std::fs::remove_dir_all(&self.0);
        }
    }

    fn map(name: &str, grid: Grid, voxels: Vec<i16>, slope: f64) -> (Folder, std::path::PathBuf) {
        let folder = Folder::new();
        let path = folder.0.join(name);
        io::write_image(&path, &Volume::new(grid, Rescale { slope, intercept: 0.0 }, voxels).to_image()).unwrap();
        (folder, path)
    }

    #[test]
    fn a_map_on_the_volumes_grid_is_read_and_any_other_is_refused_with_a_sentence() {
        let mut grid = Grid::axis_aligned([4, 3, 2], [1.0, 1.0, 2.0]);
        grid.origin = [-5.0, 7.0, 11.0];
        let voxels: Vec<i16> = (0..24).map(|n| n % 7).collect();
        for name in ["labels.nrrd", "labels.nii.gz", "labels.mha"] {
            let (_folder, path) = map(name, grid.clone(), voxels.clone(), 1.0);
            assert_eq!(read(&path, &grid).unwrap(), voxels.iter().map(|v| *v as u8).collect::<Vec<_>>(), "{name}");
        }
        let sentence = |grid_of_map: Grid, slope: f64, said: &str| {
            let count = grid_of_map.voxel_count();
            let (_folder, path) = map("labels.nrrd", grid_of_map, (0..count).map(|n| (n % 7) as i16).collect(), slope);
            let error = read(&path, &grid).unwrap_err().to_string();
            assert!(error.contains("labels.nrrd") && error.contains(said) && !error.contains('\n'), "{error}");
        };
        sentence(Grid { size: [4, 3, 3], ..grid.clone() }, 1.0, "4 × 3 × 3 voxels and the volume 4 × 3 × 2");
        sentence(Grid { origin: [-5.0, 7.2, 11.0], ..grid.clone() }, 1.0, "0.20 mm from the volume's");
        sentence(Grid { spacing: [1.0, 1.0, 2.5], ..grid.clone() }, 1.0, "0.50 mm");
        sentence(grid.clone(), 0.5, "is no label");
        sentence(grid.clone(), -1.0, "is no label");
    }
}
