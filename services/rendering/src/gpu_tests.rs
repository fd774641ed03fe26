//! Frames by the twin on a GPU: those of the CPU but for rounding; and a device that goes away, or was never there, costs no frame.

use crate::{backend::Backend, compose::Composer, in_place::World};
use maille_scene::Backend as Asked;

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

#[test]
fn a_scene_that_asks_for_nothing_opens_no_device() {
    let world = World::new();
    let mut backend = Backend::of(&world.scene, &world.reader);
    backend.begin();
    assert!(backend.gpu().is_none());
    assert_eq!(backend.end(), (false, 0));
}
