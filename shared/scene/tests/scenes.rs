//! The scenes that come with the program, and what a scene survives: being written out, and another volume.

use maille_scene::{Machine, Process, Scene, VolumeSource, plan};
use maille_volume::Grid;
use std::path::{Path, PathBuf};

fn scenes() -> Vec<PathBuf> {
    scenes_of("config")
}

fn scenes_of(folder: &str) -> Vec<PathBuf> {
    let folder = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../..")).join(folder);
    let mut found: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    found.retain(|p| p.extension().is_some_and(|e| e == "toml"));
    assert!(!found.is_empty());
    found
}

#[test]
fn every_scene_of_the_project_loads_and_plans_what_it_calls_for_and_a_page() {
    for path in scenes() {
        let scene = Scene::load(&path).unwrap_or_else(|e| panic!("{e}"));
        assert!(!scene.name.is_empty() && !scene.description.is_empty(), "{}", path.display());
        let plan = plan(&scene, &Grid::axis_aligned([64, 64, 64], [2.0, 2.0, 2.0]), Machine { cores: 2 });
        for process in [Process::Haptic, Process::Rendering, Process::Console] {
            assert!(plan.starts(process), "{}: {process:?}", path.display());
        }
        assert_eq!(plan.starts(Process::Deformation), scene.has_effect("deformation"), "{}", path.display());
    }
}

/// What they name is not part of the project: they are read without looking for it.
#[test]
fn scenes_of_patients_read_and_name_a_volume_in_a_file() {
    for path in scenes_of("config/patients") {
        let text = std::fs::read_to_string(&path).unwrap();
        let scene = Scene::parse("patient", &text).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert!(matches!(scene.volume.source(), VolumeSource::File(_)), "{}", path.display());
        assert_eq!(Scene::parse("written", &scene.to_toml()).unwrap(), scene, "{}", path.display());
    }
}

#[test]
fn the_built_in_scene_is_the_default_scene_and_needs_no_file() {
    let scene = Scene::builtin_default();
    assert_eq!(Scene::open(None, None).unwrap(), scene);
    assert!(matches!(scene.volume.source(), VolumeSource::Phantom { .. }));
}

#[test]
fn a_scene_written_out_reads_as_the_same_scene() {
    for path in scenes() {
        let scene = Scene::load(&path).unwrap();
        assert_eq!(Scene::parse("written", &scene.to_toml()).unwrap(), scene, "{}", path.display());
    }
    assert_eq!(Scene::parse("written", &Scene::default().to_toml()).unwrap(), Scene::default());
}

#[test]
fn another_volume_takes_the_approach_made_for_it_and_no_millimetres_of_the_old_one() {
    let text = "[volume]\nphantom = \"head\"\n[rendering]\neye = [1, 2, 3]\n[[tool.path]]\ntime_s = 0\nmm = [0, 0, 0]\n\
                [tool.approach]\npress_mm = 3\n[tool.elsewhere]\npress_mm = 4\n";
    let mut scene = Scene::parse("test", text).unwrap();
    scene.replace_volume("other.nrrd".into());
    let tool = scene.tool.unwrap();
    assert!(tool.path.is_empty() && scene.rendering.eye.is_none());
    assert_eq!(tool.approach.unwrap().press_mm, 4.0);
    assert_eq!(scene.volume.source(), VolumeSource::File("other.nrrd".into()));
}

#[test]
fn there_is_one_table_of_tissues_and_the_shipped_scene_has_it_written_out_with_its_sources() {
    let path = scenes().into_iter().find(|path| path.ends_with("liver-puncture.toml")).expect("the scene of the liver");
    let scene = Scene::load(&path).unwrap();
    assert_eq!(scene.needle.tissue, maille_scene::needle::defaults());
    // each row of both scenes says where its numbers come from
    let patient = scenes_of("config/patients").into_iter().find(|path| path.ends_with("liver-puncture-4dct.toml")).unwrap();
    for path in [path, patient] {
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        let rows = lines.iter().enumerate().filter(|(_, line)| **line == "[[needle.tissue]]");
        for (n, _) in rows {
            assert!(["# made up: ", "# published"].iter().any(|start| lines[n - 1].starts_with(start)), "{}:{n}", path.display());
        }
        assert!(text.contains("Fortmeier et al. 2015"), "{}", path.display());
    }
}
