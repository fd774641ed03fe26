//! Fields on a grid: displacements [mm] and other scalars, `f32`.

use crate::{
    grid::Grid,
    image::{Image, Pixels},
    volume::Rescale,
};

/// A vector a voxel; displacements are in LPS millimetres, as ITK writes them.
#[derive(Clone, Debug, PartialEq)]
pub struct VectorField {
    /// where the vectors are
    pub grid: Grid,
    /// one vector [mm, LPS] a voxel, i fastest
    pub vectors: Vec<[f32; 3]>,
}

/// A number a voxel.
#[derive(Clone, Debug, PartialEq)]
pub struct ScalarField {
    /// where the numbers are
    pub grid: Grid,
    /// one number a voxel, i fastest
    pub values: Vec<f32>,
}

impl VectorField {
    /// A field of zeros.
    pub fn zeros(grid: Grid) -> Self {
        Self { vectors: vec![[0.0; 3]; grid.voxel_count()], grid }
    }

    /// The field as a three-component `float32` image.
    pub fn to_image(&self) -> Image {
        Image {
            grid: self.grid.clone(),
            components: 3,
            frames: 1,
            rescale: Rescale::IDENTITY,
            pixels: Pixels::F32(bytemuck::cast_slice(&self.vectors).to_vec()),
        }
    }

    /// Reads a three-component image as displacements.
    ///
    /// # Errors
    /// One sentence when the image has not three components.
    pub fn from_image(image: &Image) -> Result<Self, String> {
        if image.components != 3 || image.frames != 1 {
            return Err(format!(
                "a displacement field has 3 components a voxel, this has {} (and {} frames)",
                image.components, image.frames
            ));
        }
        let numbers: Vec<f32> = image.pixels.iter_f64().map(|v| image.rescale.value(v) as f32).collect();
        Ok(Self { grid: image.grid.clone(), vectors: numbers.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect() })
    }
}

impl ScalarField {
    /// The field as a `float32` image.
    pub fn to_image(&self) -> Image {
        Image { grid: self.grid.clone(), components: 1, frames: 1, rescale: Rescale::IDENTITY, pixels: Pixels::F32(self.values.clone()) }
    }
}
