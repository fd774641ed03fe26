//! `[[organ]]`: parts of the patient by their values, coloured in sections, and one of them shown alone.
//!
//! An organ is the inside of level sets [Shimizu & Nakamura, section 4.2]: voxels of the patient at rest whose value lies in one of some ranges; of these, the
//! part connected with a seed, where one is given, and no islands. Labels move with the tissue.

use serde::{Deserialize, Serialize};

/// Organs that a scene may have: labels are bytes, and 0 is none.
pub const MOST_ORGANS: usize = 255;

/// `[[organ]]`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Organ {
    /// its name, for `rendering.alone`
    pub name: String,
    /// ranges of values, ends included [HU]
    pub hu: Vec<[f64; 2]>,
    /// only the part that is connected with this place, a fraction of the volume's box along the LPS axes
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<[f64; 3]>,
    /// the same in millimetres [LPS]; at most one of the two
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed_mm: Option<[f64; 3]>,
    /// parts smaller than this are left out [mm³], 0 or more
    pub islands_mm3: f64,
}

/// What is wrong with a scene's organs: key and sentence.
pub(crate) fn faults(organs: &[Organ], alone: Option<&str>, is_volume: bool) -> Vec<(String, String)> {
    let mut faults = Vec::new();
    if organs.len() > MOST_ORGANS {
        faults.push((
            format!("organ.{MOST_ORGANS}"),
            format!("{} organs are more than the {MOST_ORGANS} that labels tell apart", organs.len()),
        ));
    }
    for (n, organ) in organs.iter().enumerate() {
        let mut fault = |key: &str, text: String| faults.push((format!("organ.{n}{key}"), text));
        if organ.name.is_empty() || organs[..n].iter().any(|other| other.name == organ.name) {
            fault(".name", "every organ needs a name of its own".into());
        }
        if organ.hu.is_empty() {
            fault("", "an organ needs ranges of values: hu = [[low, high]]".into());
        }
        for (m, [low, high]) in organ.hu.iter().enumerate() {
            if !(low <= high && low.is_finite() && high.is_finite()) {
                fault(&format!(".hu.{m}"), format!("the range {low} to {high} HU holds nothing: give the lower end first"));
            }
        }
        if organ.seed.is_some() && organ.seed_mm.is_some() {
            fault(".seed_mm", "seed and seed_mm say the same: give one of them".into());
        }
        if !organ.seed.iter().chain(&organ.seed_mm).flatten().all(|v| v.is_finite()) {
            fault(".seed", "a seed has three finite numbers".into());
        }
        if !(organ.islands_mm3 >= 0.0 && organ.islands_mm3.is_finite()) {
            fault(".islands_mm3", format!("islands_mm3 = {} is no volume: use 0 or more", organ.islands_mm3));
        }
    }
    if let Some(alone) = alone {
        if !organs.iter().any(|organ| organ.name == alone) {
            faults.push(("rendering.alone".into(), format!("`{alone}` is no organ of this scene: name one of its [[organ]]")));
        }
        if !is_volume {
            faults.push((
                "rendering.alone".into(),
                "an organ is shown alone with mode = \"volume\": a surface at one value has no organs".into(),
            ));
        }
    }
    faults
}

#[cfg(test)]
mod tests {
    use crate::Scene;

    const HEAD: &str = "[rendering]\nalone = \"skull\"\n[[organ]]\nname = \"skull\"\nhu = [[300.0, 3000.0]]\nislands_mm3 = 100.0\n";

    #[test]
    fn organs_are_read_and_written_as_they_are() {
        let scene = Scene::parse("organs", HEAD).unwrap();
        assert_eq!((scene.organs.len(), scene.rendering.alone.as_deref()), (1, Some("skull")));
        assert_eq!(Scene::parse("again", &scene.to_toml()).unwrap().organs, scene.organs);
        assert!(Scene::builtin_default().organs.is_empty());
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_a_sentence() {
        for (from, to, said) in [
            ("alone = \"skull\"", "alone = \"liver\"", "no organ of this scene"),
            ("alone = \"skull\"", "alone = \"skull\"\nmode = \"isosurface\"", "mode = \"volume\""),
            ("[[300.0, 3000.0]]", "[[3000.0, 300.0]]", "holds nothing"),
            ("hu = [[300.0, 3000.0]]\n", "", "needs ranges"),
            ("islands_mm3 = 100.0", "islands_mm3 = -1.0", "no volume"),
            ("islands_mm3 = 100.0", "seed = [0.5, 0.5, 0.5]\nseed_mm = [0.0, 0.0, 0.0]", "give one of them"),
            ("name = \"skull\"\n", "", "name of its own"),
        ] {
            let error = Scene::parse("wrong", &HEAD.replace(from, to)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
