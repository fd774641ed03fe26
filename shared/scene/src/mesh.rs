//! `[[mesh]]`: surfaces seen among the voxels: of a file, or of an organ of the scene.
//!
//! They lie in the patient at rest, and go with breath; tissue that a tool moves leaves them where they are.

use crate::organ::Organ;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Meshes that a scene may have.
pub const MOST_MESHES: usize = 64;

/// `[[mesh]]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Mesh {
    /// .stl, .ply or .obj [mm, LPS]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// or the surface of this `[[organ]]`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub organ: Option<String>,
    /// red, green, blue, 0 to 1; by default one of a few, in turn
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color: Option<[f64; 3]>,
    /// thinned to about this many triangles
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triangles: Option<usize>,
}

/// What is wrong with a scene's meshes: key and sentence.
pub(crate) fn faults(meshes: &[Mesh], organs: &[Organ]) -> Vec<(String, String)> {
    let mut faults = Vec::new();
    if meshes.len() > MOST_MESHES {
        faults.push((
            format!("mesh.{MOST_MESHES}"),
            format!("{} meshes are more than the {MOST_MESHES} that a scene may have", meshes.len()),
        ));
    }
    for (n, mesh) in meshes.iter().enumerate() {
        let mut fault = |key: &str, text: String| faults.push((format!("mesh.{n}{key}"), text));
        match (&mesh.file, &mesh.organ) {
            (Some(_), None) => {}
            (None, Some(name)) if organs.iter().any(|organ| organ.name == *name) => {}
            (None, Some(name)) => fault(".organ", format!("`{name}` is no organ of this scene: name one of its [[organ]]")),
            _ => fault("", "a mesh is of a file or of an organ: give `file` or `organ`, one of them".into()),
        }
        if !mesh.color.iter().flatten().all(|c| (0.0..=1.0).contains(c)) {
            fault(".color", "a colour has red, green and blue, each 0 to 1".into());
        }
        if mesh.triangles == Some(0) {
            fault(".triangles", "a mesh of no triangles is not seen: leave `triangles` out, or give some".into());
        }
    }
    faults
}

#[cfg(test)]
mod tests {
    use crate::Scene;

    #[test]
    fn meshes_are_read_and_written_as_they_are_and_what_makes_no_sense_is_refused() {
        let text = "[[organ]]\nname = \"skull\"\nhu = [[300.0, 3000.0]]\n[[mesh]]\norgan = \"skull\"\ncolor = [0.9, 0.8, 0.7]\n";
        let scene = Scene::parse("mesh", text).unwrap();
        assert_eq!(Scene::parse("again", &scene.to_toml()).unwrap().meshes, scene.meshes);
        for (from, to, said) in [
            ("organ = \"skull\"", "organ = \"liver\"", "no organ of this scene"),
            ("organ = \"skull\"\n", "", "one of them"),
            ("organ = \"skull\"\n", "organ = \"skull\"\nfile = \"a.stl\"\n", "one of them"),
            ("0.9", "9.0", "each 0 to 1"),
            ("color = ", "triangles = 0\ncolor = ", "no triangles"),
        ] {
            let error = Scene::parse("wrong", &text.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
