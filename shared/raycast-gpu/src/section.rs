//! Flat sections on the device: the twin of `maille_raycast::section_with`.

use crate::{
    device::GpuError,
    render::{FrameReport, Pass, Renderer},
    variant::{Shows, Variant},
};
use bytemuck::{Pod, Zeroable};
use maille_raycast::{Overlay, Picture, RenderError, Section, SlabMode, twin};
use maille_volume::BrickSource;
use nalgebra::Vector3;

/// As `Section` in `section.wgsl`.
#[repr(C)]
#[derive(Clone, Copy, Pod, Zeroable)]
struct Packed {
    corner: [f32; 3],
    gain: f32,
    across: [f32; 3],
    level: f32,
    down: [f32; 3],
    slope: f32,
    through: [f32; 3],
    intercept: f32,
    last: [f32; 3],
    planes: f32,
    right_mm: [f32; 3],
    opaque_mm: f32,
    down_mm: [f32; 3],
    unused: f32,
    size: [u32; 2],
    nothing: [u32; 2],
}

const _: () = assert!(size_of::<Packed>() == 8 * 16);

impl Renderer {
    /// Draws a section and waits. A warp or labels of another volume are left out, as by the reference.
    ///
    /// # Errors
    /// [`GpuError`]; the picture is then untouched.
    pub fn section_with<S: BrickSource + ?Sized>(
        &mut self,
        source: &S,
        section: &Section,
        overlay: &Overlay<'_>,
        picture: &mut Picture,
    ) -> Result<FrameReport, GpuError> {
        if overlay.steps > 0 && overlay.warp.is_some() {
            return Err(GpuError::Unsupported("sections by steps of the fixed point are the CPU's".into()));
        }
        let (width, height) = (picture.width, picture.height);
        if width * height == 0 || picture.rgb.len() != 3 * width * height {
            return Err(RenderError::Picture { width, height, bytes: picture.rgb.len() }.into());
        }
        let (grid, rescale) = (&source.info().grid, source.info().rescale);
        let warp = overlay.warp.filter(|w| twin::suits(w, source));
        let labels = overlay.labels.filter(|l| l.size() == grid.size);
        let [right, down, normal] = twin::section_axes(section.plane).map(Vector3::from);
        let planes = twin::planes(section, grid.min_spacing());
        let (to_index, to_mm) = (grid.index_from_world_matrix(), grid.world_from_index_matrix());
        let index = |v: Vector3<f64>| -> [f32; 3] { <[f64; 3]>::from(to_index * v).map(|c| c as f32) };
        let row = |v: Vector3<f64>| -> [f32; 3] { <[f64; 3]>::from(to_mm.transpose() * v).map(|c| c as f32) };
        let opaque_mm = overlay.displacement_mm.filter(|_| warp.is_some());
        let packed = Packed {
            corner: grid.index_from_world(section.position(0.0, 0.0, width, height)).map(|c| c as f32),
            gain: (255.0 / section.window.max(1e-9)) as f32,
            across: index(right * section.mm_per_pixel),
            level: section.level as f32,
            down: index(down * section.mm_per_pixel),
            slope: rescale.slope as f32,
            through: index(normal * section.slab_mm),
            intercept: rescale.intercept as f32,
            last: grid.size.map(|s| (s - 1) as f32),
            planes: planes as f32,
            right_mm: row(right),
            opaque_mm: opaque_mm.map_or(1.0, |mm| mm.max(1e-9) as f32),
            down_mm: row(down),
            unused: 0.0,
            size: [width as u32, height as u32],
            nothing: [0; 2],
        };
        let lengths = [packed.corner, packed.across, packed.down, packed.through];
        if !lengths.as_flattened().iter().chain([&packed.level, &packed.gain]).all(|v| v.is_finite()) {
            // as the reference does
            picture.rgb.fill(0);
        } else {
            let variant = Variant {
                warp: warp.is_some(),
                exact: warp.is_some_and(|warp| twin::exact(warp).is_some()),
                labels: labels.is_some(),
                slab: planes > 1,
                maximum: section.slab_mode == SlabMode::Maximum,
                overlay: opaque_mm.is_some(),
                ..Variant::of(Shows::Section)
            };
            let size = [width, height];
            let (submission, report) = self.frame(&[Pass::over(variant, size)], source, size, |parts, traffic| {
                let (device, queue) = (&parts.gpu.device, &parts.gpu.queue);
                traffic.other += parts.numbers.follow(device, queue, wgpu::BufferUsages::UNIFORM, bytemuck::bytes_of(&packed));
                if let Some(warp) = warp {
                    parts.lattice.follow(parts.gpu, warp, traffic);
                }
                if let Some(labels) = labels {
                    parts.labels.follow(parts.gpu, labels, traffic);
                }
            })?;
            self.collect(submission, false, picture)?;
            self.finish_section(section, overlay, picture);
            return Ok(report);
        }
        self.finish_section(section, overlay, picture);
        Ok(FrameReport::default())
    }

    /// Outlines and depth are the reference's own.
    fn finish_section(&self, section: &Section, overlay: &Overlay<'_>, picture: &mut Picture) {
        if let Some(geometry) = overlay.geometry {
            twin::outlines(geometry, section, picture);
        }
        if let Some(depth) = &mut picture.depth {
            depth.fill(f32::INFINITY);
        }
    }
}
