//! A picture: what changed goes to the device, one shader draws, bytes come back.

use crate::{
    buffers::{Answer, Mirror},
    device::{Gpu, GpuError},
    frame::Packed,
    labels::LabelMap,
    ultrasound::Fan,
    variant::{FAR, Shows, Stage, VOXELS_BINDING, Variant},
    voxels::{Placement, Traffic, Voxels},
    warp::Lattice,
};
use maille_raycast::{Camera, Extras, Kernel, Light, Mode, Picture, Settings, Skip, WarpScheme, twin};
use maille_store::Reader;
use maille_volume::{BrickLayout, BrickSource};
use std::{collections::HashMap, sync::Arc};

/// Pixels along the edge of a workgroup, as the shaders have it.
const GROUP: usize = 8;

/// What a frame moved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameReport {
    /// for this frame alone
    pub traffic: Traffic,
    /// whether a shader had to be built for it
    pub built: bool,
}

/// A shader and how much of it: a picture is one, or several in a row.
pub(crate) struct Pass {
    pub variant: Variant,
    /// workgroups
    pub groups: [u32; 2],
}

impl Pass {
    /// An invocation for each of as many things across and down.
    pub fn over(variant: Variant, counts: [usize; 2]) -> Self {
        Self { variant, groups: counts.map(|n| n.div_ceil(GROUP) as u32) }
    }
}

/// Draws one volume on one device.
pub struct Renderer {
    pub(crate) gpu: Gpu,
    voxels: Voxels,
    notice: Option<String>,
    pipelines: HashMap<Variant, wgpu::ComputePipeline>,
    pub(crate) numbers: Mirror,
    distances: Mirror,
    table: Mirror,
    solids: Mirror,
    lattice: Lattice,
    labels: LabelMap,
    pub(crate) fan: Fan,
    pub(crate) colors: Answer,
    depths: Answer,
    pub(crate) traffic: Traffic,
}

/// A frame that the device is drawing. What it reads is kept: a source that pins an epoch lets it go after the device's answer.
pub struct Pending<'a, S> {
    renderer: &'a mut Renderer,
    /// dropped only after the device's answer
    source: Option<S>,
    submission: Option<wgpu::SubmissionIndex>,
    depth: bool,
    report: FrameReport,
}

impl Renderer {
    /// For a volume on the heap: changed bricks are uploaded.
    ///
    /// # Errors
    /// [`GpuError`] when the device has not the room.
    pub fn for_volume(gpu: Gpu, layout: &BrickLayout) -> Result<Self, GpuError> {
        let voxels = Voxels::uploaded(&gpu, layout)?;
        Ok(Self::with(gpu, voxels, None))
    }

    /// For a store, whose mapping it keeps alive.
    ///
    /// # Errors
    /// [`GpuError`] when the device has not the room. An import that fails is none: see [`Renderer::notice`].
    pub fn for_store(gpu: Gpu, reader: &Arc<Reader>, placement: Placement) -> Result<Self, GpuError> {
        let layout = *reader.rest().layout();
        let (voxels, notice) = Voxels::of_store(&gpu, reader, &layout, placement)?;
        Ok(Self::with(gpu, voxels, notice))
    }

    fn with(gpu: Gpu, voxels: Voxels, notice: Option<String>) -> Self {
        Self {
            gpu,
            voxels,
            notice,
            pipelines: HashMap::new(),
            numbers: Mirror::default(),
            distances: Mirror::default(),
            table: Mirror::default(),
            solids: Mirror::default(),
            lattice: Lattice::default(),
            labels: LabelMap::default(),
            fan: Fan::default(),
            colors: Answer::default(),
            depths: Answer::default(),
            traffic: Traffic::default(),
        }
    }

    /// A sentence for the log, when bricks are not where they were wanted.
    pub fn notice(&self) -> Option<&str> {
        self.notice.as_deref()
    }

    /// Where bricks lie.
    pub fn placement(&self) -> Placement {
        self.voxels.placement()
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Everything that was moved since the beginning.
    pub fn traffic(&self) -> Traffic {
        self.traffic
    }

    /// Draws and waits: the twin of `maille_raycast::render_extra`. The kernel of the extras is not looked at.
    ///
    /// # Errors
    /// [`GpuError`]; the picture is then untouched, and the CPU can draw the frame.
    pub fn render<S: BrickSource + ?Sized>(
        &mut self,
        extras: &Extras<'_>,
        source: &S,
        skip: &Skip,
        camera: &Camera,
        settings: &Settings,
        picture: &mut Picture,
    ) -> Result<FrameReport, GpuError> {
        let (submission, report) = self.submit(extras, source, skip, camera, settings, picture)?;
        let kept = Some(source);
        Pending { renderer: self, source: kept, submission: Some(submission), depth: picture.depth.is_some(), report }.finish(picture)
    }

    /// Lets the device begin and comes back: the source is kept until [`Pending::finish`]. Of the picture only its size matters.
    ///
    /// # Errors
    /// [`GpuError`].
    pub fn begin<S: BrickSource>(
        &mut self,
        extras: &Extras<'_>,
        source: S,
        skip: &Skip,
        camera: &Camera,
        settings: &Settings,
        picture: &Picture,
    ) -> Result<Pending<'_, S>, GpuError> {
        let (submission, report) = self.submit(extras, &source, skip, camera, settings, picture)?;
        let depth = picture.depth.is_some();
        Ok(Pending { renderer: self, source: Some(source), submission: Some(submission), depth, report })
    }

    fn submit<S: BrickSource + ?Sized>(
        &mut self,
        extras: &Extras<'_>,
        source: &S,
        skip: &Skip,
        camera: &Camera,
        settings: &Settings,
        picture: &Picture,
    ) -> Result<(wgpu::SubmissionIndex, FrameReport), GpuError> {
        if extras.zoom && matches!(settings.mode, Mode::Isosurface { .. }) && extras.warp.is_none() {
            return Err(GpuError::Unsupported("the smooth function in near views of a surface is the CPU's".into()));
        }
        if extras.warp.is_some() && extras.scheme != WarpScheme::Lattice {
            return Err(GpuError::Unsupported("rays by one step of the fixed point a sample are the CPU's".into()));
        }
        // the scalar kernel refuses what the device can draw
        let extras = &Extras { kernel: Kernel::Fastest, ..*extras };
        let numbers = twin::frame(extras, source, skip, camera, settings, picture)?;
        let size = [picture.width, picture.height];
        let solids = extras.geometry.filter(|g| !g.is_empty());
        let solids = solids.and_then(|g| twin::solids(g, camera, settings, size, extras.barrel));
        let shows = match settings.mode {
            Mode::Volume => Shows::Volume,
            Mode::Isosurface { .. } => Shows::Isosurface,
            Mode::Both { .. } => Shows::Both,
            Mode::Xray { .. } => Shows::Xray,
        };
        let (table, light) = (matches!(shows, Shows::Volume | Shows::Both), settings.shading.map(|s| s.light));
        let shaded = light.is_some() && shows != Shows::Xray;
        let variant = Variant {
            shaded,
            at_eye: shaded && matches!(light, Some(Light::AtEye { .. })),
            warp: extras.warp.is_some(),
            exact: extras.warp.is_some_and(|warp| twin::exact(warp).is_some()),
            labels: extras.labels.is_some() && table,
            depth: picture.depth.is_some(),
            ends: solids.is_some(),
            pieces: settings.adaptive.is_some() && table,
            barrel: extras.barrel > 0.0,
            ..Variant::of(shows)
        };
        self.frame(&[Pass::over(variant, size)], source, size, |this, traffic| {
            let (device, queue) = (&this.gpu.device, &this.gpu.queue);
            let storage = wgpu::BufferUsages::STORAGE;
            let packed = Packed::new(&numbers, settings, size);
            traffic.other += this.numbers.follow(device, queue, wgpu::BufferUsages::UNIFORM, bytemuck::bytes_of(&packed));
            let (distances, cells) = twin::distances(skip);
            let distances = &distances[..cells.iter().product::<usize>()];
            traffic.other += this.distances.follow(device, queue, storage, distances);
            if table {
                traffic.other += this.table.follow(device, queue, storage, bytemuck::cast_slice(&numbers.table));
            }
            if let Some(solids) = &solids {
                traffic.other += this.solids.follow(device, queue, storage, bytemuck::cast_slice(solids));
            }
            if let Some(warp) = extras.warp {
                this.lattice.follow(this.gpu, warp, traffic);
            }
            if let Some(labels) = extras.labels.filter(|_| table) {
                this.labels.follow(this.gpu, labels, traffic);
            }
            if variant.depth {
                this.depths.room(device, (4 * size[0] * size[1]) as u64);
            }
        })
    }

    /// One picture by passes, after what `prepare` sends.
    pub(crate) fn frame<S: BrickSource + ?Sized>(
        &mut self,
        passes: &[Pass],
        source: &S,
        size: [usize; 2],
        prepare: impl FnOnce(&mut PartsMut<'_>, &mut Traffic),
    ) -> Result<(wgpu::SubmissionIndex, FrameReport), GpuError> {
        let mut report = FrameReport::default();
        let outcome = self.try_frame(passes, source, size, prepare, &mut report);
        if outcome.is_err() {
            // nothing of what the device has is certain now
            self.voxels.forget();
            (self.numbers, self.distances, self.table, self.solids) = Default::default();
            (self.lattice, self.labels, self.fan, self.colors, self.depths) = Default::default();
        }
        let t = report.traffic;
        self.traffic.uploaded += t.uploaded;
        self.traffic.fetched += t.fetched;
        self.traffic.changed += t.changed;
        self.traffic.other += t.other;
        outcome.map(|submission| (submission, report))
    }

    fn try_frame<S: BrickSource + ?Sized>(
        &mut self,
        passes: &[Pass],
        source: &S,
        size: [usize; 2],
        prepare: impl FnOnce(&mut PartsMut<'_>, &mut Traffic),
        report: &mut FrameReport,
    ) -> Result<wgpu::SubmissionIndex, GpuError> {
        for Pass { variant, .. } in passes {
            if !self.pipelines.contains_key(variant) {
                let pipeline = self.build(*variant)?;
                self.pipelines.insert(*variant, pipeline);
                report.built = true;
            }
        }
        let depth = passes.iter().any(|pass| pass.variant.depth);
        let Self { gpu, voxels, pipelines, numbers, distances, table, solids, lattice, labels, fan, colors, depths, .. } = self;
        let gpu = &*gpu;
        gpu.checked(|| {
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            voxels.follow(gpu, source, &mut encoder, &mut report.traffic)?;
            colors.room(&gpu.device, (4 * size[0] * size[1]) as u64);
            let mut parts = PartsMut { gpu, numbers, distances, table, solids, lattice, labels, fan, depths };
            prepare(&mut parts, &mut report.traffic);
            let bound = Bound { voxels, numbers, distances, table, solids, lattice, labels, fan, colors, depths };
            let groups =
                passes.iter().map(|pass| bound.group(gpu, &pass.variant, &pipelines[&pass.variant])).collect::<Result<Vec<_>, _>>()?;
            {
                let mut compute = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
                for (Pass { variant, groups: [across, down] }, group) in passes.iter().zip(&groups) {
                    compute.set_pipeline(&pipelines[variant]);
                    compute.set_bind_group(0, group, &[]);
                    compute.dispatch_workgroups(*across, *down, 1);
                }
            }
            colors.fetch(&mut encoder);
            if depth {
                depths.fetch(&mut encoder);
            }
            let submission = gpu.queue.submit([encoder.finish()]);
            colors.map();
            if depth {
                depths.map();
            }
            Ok(submission)
        })
    }

    fn build(&self, variant: Variant) -> Result<wgpu::ComputePipeline, GpuError> {
        let source = variant.source(self.voxels.layout(), self.voxels.buffers().count());
        self.gpu.checked(|| {
            let device = &self.gpu.device;
            let module =
                device.create_shader_module(wgpu::ShaderModuleDescriptor { label: None, source: wgpu::ShaderSource::Wgsl(source.into()) });
            Ok(device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: None,
                layout: None,
                module: &module,
                entry_point: Some("main"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                cache: None,
            }))
        })
    }

    /// Waits for a submission and hands the picture's bytes on.
    pub(crate) fn collect(&mut self, submission: wgpu::SubmissionIndex, depth: bool, picture: &mut Picture) -> Result<(), GpuError> {
        let outcome = self.gpu.wait(submission).and_then(|()| {
            let lost = |reason: String| GpuError::Lost(reason);
            // depth first: a picture is whole or untouched
            if depth && let Some(to) = &mut picture.depth {
                let far = |d: f32| if d < FAR { d } else { f32::INFINITY };
                let copy = |bytes: &[u8]| {
                    to.iter_mut().zip(bytes.as_chunks::<4>().0).for_each(|(to, b)| *to = far(f32::from_le_bytes(*b)));
                };
                self.depths.with(copy).map_err(lost)?;
            }
            let rgb = picture.rgb.as_chunks_mut::<3>().0;
            let copy = |bytes: &[u8]| rgb.iter_mut().zip(bytes.as_chunks::<4>().0).for_each(|(to, &[r, g, b, _])| *to = [r, g, b]);
            self.colors.with(copy).map_err(lost)
        });
        if outcome.is_err() {
            (self.colors, self.depths) = Default::default();
            self.voxels.forget();
        }
        outcome
    }
}

/// What a frame's data goes into.
pub(crate) struct PartsMut<'a> {
    pub gpu: &'a Gpu,
    pub numbers: &'a mut Mirror,
    pub distances: &'a mut Mirror,
    pub table: &'a mut Mirror,
    pub solids: &'a mut Mirror,
    pub lattice: &'a mut Lattice,
    pub labels: &'a mut LabelMap,
    pub fan: &'a mut Fan,
    pub depths: &'a mut Answer,
}

/// What shaders are given.
struct Bound<'a> {
    voxels: &'a Voxels,
    numbers: &'a Mirror,
    distances: &'a Mirror,
    table: &'a Mirror,
    solids: &'a Mirror,
    lattice: &'a Lattice,
    labels: &'a LabelMap,
    fan: &'a Fan,
    colors: &'a Answer,
    depths: &'a Answer,
}

impl Bound<'_> {
    /// Of this, what a variant asks for.
    fn group(&self, gpu: &Gpu, variant: &Variant, pipeline: &wgpu::ComputePipeline) -> Result<wgpu::BindGroup, GpuError> {
        let mut bindings = match variant.shows {
            Shows::Ultrasound(stage) => self.of_fan(stage, variant.speckle),
            _ => self.of_picture(variant),
        };
        if variant.warp {
            bindings.extend(self.lattice.bindings());
        }
        if variant.samples() {
            bindings.push((3, self.voxels.index()));
            bindings.extend((VOXELS_BINDING..).zip(self.voxels.buffers().map(Some)));
        }
        let mut entries = Vec::with_capacity(bindings.len());
        for (binding, buffer) in bindings {
            let buffer = buffer.ok_or_else(|| GpuError::Unsupported(format!("nothing for binding {binding}")))?;
            if buffer.size() > gpu.limits.max_storage_buffer_binding_size {
                let mib = gpu.limits.max_storage_buffer_binding_size >> 20;
                return Err(GpuError::Unsupported(format!("its shaders see at most {mib} MiB at once: a map or the picture has more")));
            }
            entries.push(wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() });
        }
        let layout = pipeline.get_bind_group_layout(0);
        Ok(gpu.device.create_bind_group(&wgpu::BindGroupDescriptor { label: None, layout: &layout, entries: &entries }))
    }

    fn of_picture(&self, variant: &Variant) -> Vec<(u32, Option<&wgpu::Buffer>)> {
        let mut bindings = vec![(0, self.numbers.buffer()), (1, self.colors.written())];
        if variant.depth {
            bindings.push((2, self.depths.written()));
        }
        if variant.shows != Shows::Section {
            bindings.push((4, self.distances.buffer()));
        }
        if variant.labels {
            bindings.extend(self.labels.bindings());
        }
        if matches!(variant.shows, Shows::Volume | Shows::Both) {
            bindings.push((10, self.table.buffer()));
        }
        if variant.ends {
            bindings.push((11, self.solids.buffer()));
        }
        bindings
    }

    fn of_fan(&self, stage: Stage, speckle: bool) -> Vec<(u32, Option<&wgpu::Buffer>)> {
        let fan = self.fan;
        let (ways, weights) = ((12, fan.ways.buffer()), (13, fan.weights.buffer()));
        let (tissues, greys, places) = ((7, fan.tissues.buffer()), (14, fan.greys.buffer()), (15, fan.places.buffer()));
        let mut bindings = vec![(0, fan.numbers.buffer())];
        match stage {
            Stage::Gather => bindings.extend([ways, tissues, places]),
            Stage::Walk => bindings.extend([tissues, greys]),
            Stage::Echo => bindings.extend([ways, tissues, greys, places]),
            Stage::Pulse if speckle => bindings.extend([weights, tissues, places]),
            Stage::Pulse => bindings.extend([tissues, places]),
            Stage::Beam => bindings.extend([weights, greys, places]),
            Stage::Scan => bindings.extend([greys, (1, self.colors.written())]),
        }
        bindings
    }
}

impl<S> Pending<'_, S> {
    /// Waits for the device, fills the picture, and lets the source go.
    ///
    /// # Errors
    /// [`GpuError`] when the device was lost meanwhile, or the picture has another size than the one begun; it is untouched then.
    pub fn finish(mut self, picture: &mut Picture) -> Result<FrameReport, GpuError> {
        let pixels = self.renderer.colors.written().map_or(0, |b| b.size() as usize / 4);
        if picture.rgb.len() != 3 * pixels || (self.depth && picture.depth.as_ref().is_none_or(|d| d.len() != pixels)) {
            return Err(GpuError::Unsupported("the picture has another size than the one that was begun".into()));
        }
        let submission = self.submission.take().expect("taken only here and when dropped");
        let outcome = self.renderer.collect(submission, self.depth, picture);
        drop(self.source.take());
        outcome.map(|()| self.report)
    }
}

impl<S> Drop for Pending<'_, S> {
    fn drop(&mut self) {
        if let Some(submission) = self.submission.take() {
            // nobody wants the picture, but the device may still read what the source keeps
            if self.renderer.gpu.wait(submission).is_ok() {
                self.renderer.colors.forget();
                if self.depth {
                    self.renderer.depths.forget();
                }
            }
        }
        drop(self.source.take());
    }
}
