//! Every fault of a scene is refused on its line, with what was probably meant.

use maille_scene::{Scene, SceneError};
use std::fs;

fn fault(text: &str) -> SceneError {
    Scene::parse("scene.toml", text).expect_err("this scene has a fault")
}

#[test]
fn an_unknown_key_is_marked_and_the_nearest_key_is_suggested() {
    let error = fault("name = \"x\"\n\n[deformation]\noffset = 0.2\ntreshold_hu = -300\n");
    assert_eq!(error.to_string(), "scene.toml:5: unknown key `treshold_hu`, did you mean `threshold_hu`?");
    assert_eq!(error.marked(), Some("treshold_hu"));
    let error = fault("[tool.approach]\nperiod = 3");
    assert!(error.to_string().contains("scene.toml:2") && error.to_string().contains("did you mean `period_s`?"), "{error}");
    let error = fault("[[tool.path]]\ntimes = 0.0");
    assert!(error.to_string().contains("unknown key `times`, did you mean `time_s`?"), "{error}");
    let error = fault("[rendring]\n");
    assert!(error.to_string().contains("unknown key `rendring`, did you mean `rendering`?"), "{error}");
}

#[test]
fn an_unknown_word_is_answered_with_the_words_there_are() {
    let error = fault("accuracy = \"drafty\"");
    assert_eq!(error.to_string(), "scene.toml:1: unknown word `drafty`, did you mean `draft`?");
    assert_eq!(error.marked(), Some("\"drafty\""));
    let error = fault("[volume]\nphantom = \"foot\"");
    assert!(error.to_string().contains("`head`") && error.to_string().contains("`torso`"), "{error}");
    let error = fault("[tool]\ndevice = \"simm\"\n[tool.approach]");
    assert!(error.to_string().contains("did you mean `sim`?"), "{error}");
    let error = fault("[tool]\ndevice = \"inverse4\"\n[tool.approach]");
    assert!(error.to_string().contains("did you mean `inverse3`?"), "{error}");
    let error = fault("[tool]\nkind = \"blade\"\n[tool.approach]");
    assert!(error.to_string().contains("cutting"), "{error}");
    let error = fault("[device]\nprofile = \"feather\"");
    assert!(error.to_string().contains("sigma.7") || error.to_string().contains("no profile"), "{error}");
    let error = fault("[device]\nrotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]]");
    assert!(error.to_string().contains("no rotation"), "{error}");
    for (address, what) in [
        ("nonsense", "no port"),
        ("127.0.0.1", "no port"),
        ("127.0.0.1:", "no port"),
        ("127.0.0.1:0", "`0` is no port"),
        ("127.0.0.1:70000", "`70000` is no port"),
        (":10001", "no host"),
        ("a host:10001", "no host"),
        ("::1:10001", "no host"),
        ("[::g]:10001", "no host"),
        ("ws://127.0.0.1:10001", "scheme"),
        ("", "no port"),
    ] {
        let error = fault(&format!("[device]\naddress = \"{address}\""));
        assert!(error.to_string().contains("scene.toml:2: device.address is no address") && error.to_string().contains(what), "{error}");
    }
    for address in ["127.0.0.1:10001", "localhost:80", "haply_2.local:65535", "[::1]:10001"] {
        assert!(Scene::parse("scene.toml", &format!("[device]\naddress = \"{address}\"")).is_ok(), "{address}");
    }
    for (key, value) in [("id", "  "), ("id", "Default\\u0000Device"), ("library", ""), ("library", "a\\u0000b")] {
        let error = fault(&format!("[device]\n{key} = \"{value}\""));
        assert!(error.to_string().contains(&format!("scene.toml:2: device.{key} is no")), "{error}");
    }
    for mirrored in [
        "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]]",
        "[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]",
        "[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]",
    ] {
        let error = fault(&format!("[device]\nrotation = {mirrored}"));
        assert!(error.to_string().contains("reflection"), "{error}");
    }
}

#[test]
fn a_number_out_of_range_is_marked_with_the_range_that_is_allowed() {
    let error = fault("[deformation]\noffset = 1.5");
    assert_eq!(error.to_string(), "scene.toml:2: offset = 1.5 is out of range");
    assert_eq!(error.marked(), Some("1.5"));
    assert_eq!(error.advice(), Some("use a number from 0.01 to 0.99"));
    for text in ["nan", "-inf", "1e300", "-1"] {
        let error = fault(&format!("[haptic]\nmax_force_n = {text}"));
        assert_eq!(error.marked(), Some(text));
    }
    let error = fault("[volume]\nsize = [256, 4, 256]");
    assert_eq!(error.marked(), Some("4"));
    let error = fault("[[tissue]]\nname = \"a\"\nhu = [0, 100]\n[[tissue]]\nname = \"b\"\nhu = [50, 200]");
    assert!(error.to_string().starts_with("scene.toml:6: tissue `b` begins at 50 HU"), "{error}");
}

#[test]
fn every_limit_refuses_what_lies_beyond_both_its_ends() {
    for limit in maille_scene::limits::LIMITS {
        let (section, key) = limit.path.split_once('.').unwrap();
        let tool = if section == "tool" { "" } else { "[tool]\n[tool.approach]\n" };
        let approach = if section == "tool" { "[tool.approach]\n" } else { "" };
        for beyond in [limit.low - 1.0, limit.high + 1.0] {
            let error = fault(&format!("{tool}[{section}]\n{key} = {beyond}\n{approach}"));
            assert_eq!(error.marked(), Some(format!("{beyond}").as_str()), "{}: {error}", limit.path);
        }
        for allowed in [limit.low, limit.high] {
            // at an end of its range a value may still disagree with another one: then the fault says so, and names no range
            let text = format!("{tool}[{section}]\n{key} = {allowed}\n{approach}");
            if let Err(error) = Scene::parse("scene.toml", &text) {
                assert!(!error.to_string().contains("out of range"), "{}: {error}", limit.path);
            }
        }
    }
}

#[test]
fn all_faults_of_a_scene_are_told_at_once() {
    let error = fault("[deformation]\noffset = 2\n[haptic]\nrate_hz = 5\n[rendering]\nstep = 0");
    assert_eq!(error.others().len(), 2);
}

#[test]
fn effects_are_known_available_and_not_alone() {
    let error = fault("[effects]\nsection = true");
    assert_eq!(error.to_string(), "scene.toml:2: unknown effect `section`, did you mean `sections`?");
    let error = fault("[effects]\nlabels = true");
    assert!(error.to_string().contains("unknown effect `labels`"), "what a table calls for is not asked for by its name: {error}");
    let error = fault("[effects]\nrecording = true");
    assert!(error.to_string().contains("needs `contact`"), "{error}");
    let error = fault("[tool]\n[tool.approach]\n[effects]\nrecording = { file = 3 }");
    assert!(error.to_string().contains("`file` is the name of a file"), "{error}");
    let error = fault("[effects]\nneedle = true");
    assert!(error.to_string().contains("needs a needle to be held"), "{error}");
    let error = fault("[effects]\ndeformation = true");
    assert!(error.to_string().contains("needs `contact`"), "{error}");
    assert_eq!(error.advice(), Some("add a [tool] table, or set `deformation = false`"));
    let error = fault("[effects]\nsections = { enabled = true, size = 3 }");
    assert!(error.to_string().contains("unknown key `size`"), "{error}");
    let scene = Scene::parse("ok", "[effects]\nneedle = false\nsections = { enabled = false }").unwrap();
    assert!(!scene.has_effect("needle") && !scene.has_effect("sections"));
}

/// An effect without its tool, its setting or its table would cost memory and show nothing.
#[test]
fn halves_of_a_pair_are_refused_with_what_is_missing() {
    const TOOL: &str = "[tool]\nradius_mm = 2\n[[tool.path]]\ntime_s = 0\nmm = [0, 0, 0]\n";
    for (text, says) in [
        (format!("{TOOL}[effects]\ndeformation = true\ncutting = true"), "needs a blade to be held"),
        (format!("{TOOL}[effects]\npalpation = true"), "needs a tool with a face"),
        (TOOL.replace("radius_mm = 2", "kind = \"blade\""), "good for nothing without the effect `cutting`"),
        (TOOL.replace("radius_mm = 2", "shape = \"finger\""), "needs the effect `palpation`"),
        (format!("{TOOL}[effects]\ndeformation = true\nrelaxation = true\nplasticity = true"), "needs elastic relaxation"),
        (
            format!("{TOOL}[effects]\ndeformation = true\nrelaxation = true\nplasticity = true\n[deformation]\nrelaxation = \"elastic\""),
            "finds no tissue that is plastic",
        ),
        ("[breathing]\nperiod_s = 4".into(), "does not breathe"),
        (TOOL.replace("radius_mm = 2", "shape = \"shaft\"\nshaft_mm = 41"), "longer than the balls that feel for it"),
        ("[effects]\nsections = \"yes\"".into(), "an effect is `true`, `false`, or a table of its settings"),
    ] {
        let error = fault(&text);
        assert!(error.to_string().contains(says), "{text}\n{error}");
        assert!(error.advice().is_some() || text.contains("yes"), "{error}");
    }
    let rows =
        |n: i32| (0..n).map(|k| format!("[[tissue]]\nname = \"t{k}\"\nhu = [{}, {}]\nstiffness_n_per_mm = 1\n", 10 * k, 10 * k + 10));
    let error = fault(&rows(33).collect::<String>());
    assert!(error.to_string().contains("33 tissue rows are more than the 32"), "{error}");
    assert!(Scene::parse("ok", &rows(32).collect::<String>()).is_ok());
    assert!(Scene::parse("ok", "[effects]\nbreathing = false\n[breathing]\nperiod_s = 4").is_ok());
}

#[test]
fn way_points_have_one_place_each_and_times_that_increase() {
    let error = fault("[[tool.path]]\ntime_s = 0\nmm = [0, 0, 0]\nfraction = [0, 0, 0]");
    assert!(error.to_string().contains("exactly one of `mm` and `fraction`"), "{error}");
    let error = fault("[[tool.path]]\ntime_s = 1\nmm = [0, 0, 0]\n[[tool.path]]\ntime_s = 1\nmm = [1, 0, 0]");
    assert!(error.to_string().starts_with("scene.toml:5: way point 2 is at 1 s"), "{error}");
    let error = fault("[[tool.path]]\ntime_s = 0\nmm = [0, nan, 0]");
    assert!(error.to_string().contains("is not a point"), "{error}");
    let error = fault("[tool]\nradius_mm = 2");
    assert!(error.to_string().contains("no way to go"), "{error}");
}

#[test]
fn broken_toml_is_refused_where_it_breaks() {
    let error = fault("name = \"x\"\n[deformation\noffset = 0.2");
    assert!(error.to_string().starts_with("scene.toml:2:"), "{error}");
    let error = fault("[deformation]\noffset = \"soft\"");
    assert_eq!(error.marked(), Some("\"soft\""));
}

#[test]
fn files_are_looked_up_beside_the_scene_and_a_missing_one_points_at_its_line() {
    let folder = std::env::temp_dir().join(format!("maille-scene-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    let scene = folder.join("scene.toml");
    fs::write(folder.join("patient.nrrd"), "").unwrap();
    fs::write(&scene, "[volume]\nfile = \"patient.nrrd\"\n").unwrap();
    assert_eq!(Scene::load(&scene).unwrap().volume.file, Some(folder.join("patient.nrrd")));

    fs::write(&scene, "[volume]\nfile = \"pateint.nrrd\"\n").unwrap();
    let error = Scene::load(&scene).unwrap_err();
    assert!(error.to_string().ends_with("scene.toml:2: there is no volume file pateint.nrrd"), "{error}");
    assert_eq!(error.marked(), Some("\"pateint.nrrd\""));
    assert!(error.advice().unwrap().contains("did you mean `patient.nrrd`?"));
    // with another volume put in, the scene's own is not looked for
    let patient = folder.join("patient.nrrd");
    assert_eq!(Scene::open(Some(&scene), Some(&patient)).unwrap().volume.file, Some(patient));
    // nor its motion model, with another one put in
    fs::write(&scene, "[volume]\nphantom = \"torso\"\n[breathing]\nmodel = \"none.motion\"\n[effects]\nbreathing = true\n").unwrap();
    let model = folder.join("other.motion");
    assert!(Scene::open(Some(&scene), None).unwrap_err().to_string().contains("none.motion"));
    assert!(Scene::open_with(Some(&scene), None, Some(&model)).unwrap_err().to_string().contains("other.motion"));
    fs::write(&model, "").unwrap();
    assert_eq!(Scene::open_with(Some(&scene), None, Some(&model)).unwrap().breathing.model, Some(model));

    fs::write(&scene, "[rendering]\ntransfer = \"bnoe\"\n").unwrap();
    let error = Scene::load(&scene).unwrap_err();
    assert!(error.advice().unwrap().contains("did you mean `bone`?"), "{error} {:?}", error.advice());

    fs::write(folder.join("way.toml"), "loop = true\n[[path]]\ntime_s = 0\nmm = [1, 2, 3]\n").unwrap();
    fs::write(&scene, "[tool]\ndevice = \"path:way.toml\"\n[tool.approach]\n").unwrap();
    let tool = Scene::load(&scene).unwrap().tool.unwrap();
    assert_eq!(tool.path[0].mm, Some([1.0, 2.0, 3.0]));
    assert!(Scene::load(folder.join("none.toml")).unwrap_err().to_string().contains("cannot read the scene"));
    fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn a_patient_whom_nothing_tells_how_to_breathe_is_refused() {
    let error = fault("[volume]\nphantom = \"head\"\n[effects]\nbreathing = true");
    assert!(error.to_string().starts_with("scene.toml:4: nothing says how this patient breathes"), "{error}");
    assert!(error.advice().is_some_and(|advice| advice.contains("maille motion fit")));
    let torso = |breathing: &str| format!("[volume]\nphantom = \"torso\"\n[breathing]\n{breathing}\n[effects]\nbreathing = true");
    assert!(Scene::parse("scene.toml", &torso("")).is_ok());
    assert!(fault(&torso("precision_bits = 24")).to_string().contains("16 or 32 bits"));
    assert!(fault(&torso("depth = 2")).to_string().contains("depth = 2 is out of range"));
    let folder = std::env::temp_dir().join(format!("maille-scene-breath-{}", std::process::id()));
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("spirometry.csv"), "").unwrap();
    fs::write(folder.join("scene.toml"), torso("signal = \"spirometri.csv\"")).unwrap();
    let error = Scene::load(folder.join("scene.toml")).unwrap_err();
    assert!(
        error.to_string().contains("there is no trace of breathing") && error.advice().unwrap().contains("did you mean `spirometry.csv`?"),
        "{error}"
    );
    fs::remove_dir_all(&folder).unwrap();
}

const NEEDLE: &str = "[tool]\nkind = \"needle\"\n[[tool.path]]\ntime_s = 0\nmm = [0, 0, 0]\n[effects]\nneedle = true\n[needle]\n";

#[test]
fn a_needle_that_cannot_be_is_refused() {
    for (line, says) in [
        ("nodes = 65", "nodes = 65 is out of range"),
        ("bent_radius_mm = 5", "bent_radius_mm = 5 is out of range"),
        ("bent_from_mm = -1", "bent_from_mm = -1 is out of range"),
        ("[[needle.tissue]]\nname = \"gristle\"", "tissue `gristle` is nowhere"),
    ] {
        let error = fault(&format!("{NEEDLE}{line}"));
        assert!(error.to_string().contains(says), "{error}");
    }
    let bent = Scene::parse("bent", &format!("{NEEDLE}bent_radius_mm = 150\nbent_from_mm = 80")).unwrap();
    assert_eq!((bent.needle.bent_radius_mm, bent.needle.bent_from_mm), (Some(150.0), 80.0));
}

#[test]
fn a_target_outside_the_volume_is_refused() {
    let volume = maille_scene::BoxMm { low: [-100.0; 3], high: [100.0; 3] };
    let scene = |at: &str| Scene::parse("target", &format!("{NEEDLE}target_mm = {at}")).unwrap();
    assert!(scene("[0, 0, 99]").resolve_path(&volume, |_| None).is_ok());
    let error = scene("[0, 9000, 0]").resolve_path(&volume, |_| None).unwrap_err();
    assert!(error.to_string().contains("target_mm") && error.to_string().contains("outside the volume"), "{error}");
}
