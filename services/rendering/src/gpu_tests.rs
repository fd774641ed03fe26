//! Frames by the twin on a GPU: those of the CPU but for rounding; and a device that goes away, or was never there, costs no frame.

use crate::{backend::Backend, compose::Composer, in_place::World};
use bytemuck::Zeroable;
use maille_contract::{FrameHeader, Switches, ToolState};
use maille_raycast::{Motion, Warp, WarpOptions};
use maille_scene::{Backend as Asked, EffectSetting, registry};
use maille_store::Snapshot;
use maille_transport::Untimed;
use maille_volume::{BrickSource, VectorField};

/// A world whose scene asks for a GPU, and a composer that has one; without any a sentence, or under CI a failure.
fn with_gpu() -> Option<(World, Composer)> {
    let mut world = World::new();
    world.scene.rendering.backend = Asked::Gpu;
    let mut composer = Composer::new(&world.scene);
    composer.backend = Backend::of(&world.scene, &world.reader);
    if composer.backend.gpu().is_none() {
        assert!(std::env::var_os("CI").is_none(), "CI needs a Vulkan driver (Mesa's lavapipe: mesa-vulkan-drivers)");
        eprintln!("SKIPPED: there is no Vulkan driver, so no frame by a GPU");
        return None;
    }
    Some((world, composer))
}

/// Share of bytes that differ by more than 2.
fn far(a: &[u8], b: &[u8]) -> f64 {
    a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 2).count() as f64 / a.len() as f64
}

#[test]
fn a_frame_by_the_gpu_is_the_cpus_and_one_whose_device_is_lost_is_drawn_by_the_cpu() {
    let Some((world, mut composer)) = with_gpu() else { return };
    let snapshot = world.reader.snapshot();
    let by_cpu = world.draw(&mut Composer::new(&world.scene), &snapshot);
    let by_gpu = world.draw(&mut composer, &snapshot);
    assert_eq!(composer.backend.end(), (true, 0));
    let differs = far(&by_cpu, &by_gpu);
    println!("{}: {:.4} % of bytes differ by more than 2", composer.backend.gpu().unwrap().name(), 100.0 * differs);
    assert!(differs <= 0.001, "{differs}");
    assert!(by_gpu.iter().any(|&v| v > 40), "something is seen");

    // taken away in the midst of the run: this frame and all that follow are the CPU's, bit for bit
    composer.backend.gpu().unwrap().give_up();
    for (failures, said) in [(1, "the frame in which it was lost"), (0, "the next")] {
        assert!(world.draw(&mut composer, &snapshot) == by_cpu, "{said}");
        assert_eq!(composer.backend.end(), (false, failures), "{said}");
    }
    assert!(composer.backend.gpu().is_none());
}

/// A frame with a probe on the ball, and of its pictures the fan alone.
fn with_probe(world: &World, composer: &mut Composer, snapshot: &Snapshot<'_>, warp: Option<&Warp>) -> [Vec<u8>; 2] {
    let mut tool = ToolState::zeroed();
    (tool.tip_mm, tool.proxy_mm, tool.direction, tool.radius_mm) = ([31.0, 2.0, 30.0], [31.0, 2.0, 30.0], [0.0, 1.0, 0.1], 2.0);
    composer.draw(snapshot, warp, &world.view(), Some(&tool), true, None, &mut Untimed).unwrap();
    let mut pixels = vec![0; composer.bytes()];
    composer.write(&mut pixels, FrameHeader::default());
    [pixels, composer.pictures[4].rgb.clone()]
}

#[test]
fn ultrasound_is_the_gpus_too_through_breath_and_without_and_the_cpus_when_it_is_lost_in_its_frame() {
    let Some((mut world, mut composer)) = with_gpu() else { return };
    world.scene.effects.insert("ultrasound".into(), EffectSetting::Switch(true));
    let backend = std::mem::take(&mut composer.backend);
    composer = Composer::new(&world.scene);
    composer.backend = backend;
    let mut by_cpu = Composer::new(&world.scene);
    let snapshot = world.reader.snapshot();
    let mut field = VectorField::zeros(snapshot.info().grid.clone());
    field.vectors.iter_mut().enumerate().for_each(|(n, v)| *v = [0.0, 3.0 * (n as f32 / 262_144.0 * 3.0).sin(), 1.0]);
    let mut warp = Warp::new(snapshot.info(), WarpOptions::default());
    warp.update(snapshot.info(), &Motion::single(&field).unwrap(), &[1.0]).unwrap();
    for warp in [None, Some(&warp)] {
        let ([whole, fan], [cpu, cpu_fan]) =
            (with_probe(&world, &mut composer, &snapshot, warp), with_probe(&world, &mut by_cpu, &snapshot, warp));
        assert_eq!(composer.backend.end(), (true, 0), "all pictures of the frame are the GPU's");
        let (all, own) = (far(&cpu, &whole), far(&cpu_fan, &fan));
        println!("{:.4} % of bytes differ by more than 2, {:.4} % of the fan's", 100.0 * all, 100.0 * own);
        assert!(all <= 0.001 && own <= 0.001, "{all}, {own}");
        assert!(fan.iter().filter(|&&v| v > 40).count() > 300, "an echo is seen");
    }
    // switched off and on again it is the same
    let [before, _] = with_probe(&world, &mut composer, &snapshot, None);
    let mut switches: Switches = Zeroable::zeroed();
    for on in [false, true] {
        switches.switch(registry::place("ultrasound").unwrap(), on);
        composer.switch(&world.scene, &switches);
    }
    assert!(with_probe(&world, &mut composer, &snapshot, None)[0] == before);
    // only the fan is asked for in the frame in which the device goes away
    let [_, expected] = with_probe(&world, &mut by_cpu, &snapshot, None);
    composer.backend.begin();
    composer.backend.gpu().unwrap().give_up();
    let mut tool = ToolState::zeroed();
    (tool.proxy_mm, tool.direction) = ([31.0, 2.0, 30.0], [0.0, 1.0, 0.1]);
    let settings = maille_raycast::Ultrasound::new(crate::overlay::probe(&tool));
    let mut picture = by_cpu.pictures[4].clone();
    picture.rgb.fill(7);
    composer.backend.ultrasound(&snapshot, &settings, None, &mut picture).unwrap();
    assert!(picture.rgb == expected, "bit for bit the CPU's");
    assert_eq!(composer.backend.end(), (false, 1));
    assert!(composer.backend.gpu().is_none());
}

#[test]
fn a_scene_that_asks_for_nothing_opens_no_device() {
    let world = World::new();
    let mut backend = Backend::of(&world.scene, &world.reader);
    backend.begin();
    assert!(backend.gpu().is_none());
    assert_eq!(backend.end(), (false, 0));
}
