//! A picture as bytes, and the depth behind each pixel when somebody asks for it.

/// An RGB picture; row 0 is the top.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Picture {
    /// pixels across
    pub width: usize,
    /// pixels down
    pub height: usize,
    /// red, green, blue of each pixel, `3 · width · height` bytes, rows from the top
    pub rgb: Vec<u8>,
    /// distance from the eye [mm] along each pixel's ray to what is seen there (isosurface: the hit; volume: where half the
    /// light is gone), infinite where nothing is; filled only when present, `width · height` numbers
    pub depth: Option<Vec<f32>>,
}

impl Picture {
    /// A black picture.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, rgb: vec![0; 3 * width * height], depth: None }
    }

    /// The same with room for depth.
    pub fn with_depth(width: usize, height: usize) -> Self {
        Self { depth: Some(vec![f32::INFINITY; width * height]), ..Self::new(width, height) }
    }

    /// Changes the size; keeps the memory it has.
    pub fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.rgb.resize(3 * width * height, 0);
        if let Some(depth) = &mut self.depth {
            depth.resize(width * height, f32::INFINITY);
        }
    }

    /// Colour of a pixel.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        let at = 3 * (y * self.width + x);
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }
}
