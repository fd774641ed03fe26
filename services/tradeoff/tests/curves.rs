//! The table of curves, and the page of a report.

use maille_scene::{limits::limit, registry::KNOBS};
use maille_tradeoff::{Effort, KnobOf, Options, Theory, chosen, curves, tradeoff};
use std::collections::BTreeSet;

#[test]
fn every_knob_of_the_registry_has_one_curve_and_every_curve_says_what_it_measures() {
    for knob in KNOBS {
        let own: Vec<_> = curves().filter(|c| c.registered() == Some(knob.name)).collect();
        assert_eq!(own.len(), 1, "{} has {} curves", knob.name, own.len());
        assert_eq!((own[0].name, own[0].defaults()), (knob.name, Some(knob.defaults)));
        assert!(limit(knob.name).is_some());
    }
    let mut names = BTreeSet::new();
    for c in curves() {
        assert!(names.insert(c.name), "{} stands twice", c.name);
        for text in [c.name, c.engine, c.title, c.error, c.unit, c.truth, c.timed] {
            assert!(!text.trim().is_empty(), "{}: a word is missing", c.name);
        }
        if let KnobOf::Registry(name) = c.knob {
            assert!(KNOBS.iter().any(|k| k.name == name), "{name} is not in the registry");
        }
        if let Theory::Not(why) = c.theory {
            assert!(why.len() > 40, "{}: say why", c.name);
        }
    }
}

#[test]
fn names_choose_curves_by_name_by_engine_and_by_beginning() {
    let names = |only: &[&str]| -> Vec<&str> {
        chosen(&only.iter().map(|s| (*s).to_string()).collect::<Vec<_>>()).unwrap().iter().map(|c| c.name).collect()
    };
    assert_eq!(names(&["rendering.step"]), ["rendering.step"]);
    assert_eq!(names(&["rendering"]), ["rendering.step", "rendering.opacity_end", "rendering.scale", "rendering.warp_scheme"]);
    assert!(names(&["chainmail"]).contains(&"deformation.offset"));
    assert_eq!(names(&[]).len(), curves().count());
    assert!(chosen(&["nothing".into()]).is_err_and(|e| e.to_string().contains("rendering.step")));
}

/// Whatever is asked for: what there is no time for is named, and what was measured in haste as well.
#[test]
fn what_there_is_no_time_for_is_left_out_by_its_name() {
    let only = vec!["contact".into()];
    let options = Options { only, effort: Effort::Quick, within: Some(std::time::Duration::from_millis(20)), volume: None, data: None };
    let report = tradeoff(&options, |_| {}).unwrap();
    let asked = chosen(&options.only).unwrap();
    assert!(!report.cut_short.is_empty() && report.curves.len() < asked.len(), "20 ms are enough for {:?}", report.took_s);
    for curve in asked {
        let measured = report.curves.iter().find(|c| c.name == curve.name);
        let named = report.cut_short.iter().any(|line| line.starts_with(curve.name));
        assert!(named || measured.is_some_and(|c| c.subjects.iter().all(|s| s.rounds >= 3)), "{} is silent", curve.name);
    }
    let shown = report.to_string();
    assert!(report.cut_short.iter().all(|line| shown.contains(line) && report.to_html().contains(line)), "{shown}");
}

/// Two knobs of touch, which are done in a second: the marked settings, the front for a governor, the page.
#[test]
fn a_report_has_its_marks_its_front_and_a_page_with_every_curve() {
    let options = Options { only: vec!["contact".into()], effort: Effort::Quick, within: None, volume: None, data: None };
    let report = tradeoff(&options, |_| {}).unwrap();
    assert_eq!(report.curves.len(), chosen(&options.only).unwrap().len());
    let page = report.to_html();
    for curve in &report.curves {
        assert!(page.contains(&format!("<section id=\"{}\">", curve.name)) && page.contains(&curve.command));
        for subject in &curve.subjects {
            assert!(subject.rounds >= 3 && subject.points.iter().filter(|p| p.is_reference).count() == 1);
            assert!(subject.points.iter().any(|p| p.front));
            if curve.defaults.is_some() {
                for word in ["draft", "balanced", "reference"] {
                    assert_eq!(subject.points.iter().filter(|p| p.accuracy.contains(&word)).count(), 1, "{}: {word}", curve.name);
                }
            }
        }
    }
    assert!(!page.contains("http"), "the page names another place");
    // fewer balls, less depth missed, as theory says: by formula, so on any machine
    let balls = report.curves.iter().find(|c| c.name == "contact.balls").unwrap();
    let errors: Vec<f64> = balls.subjects[0].points.iter().map(|p| p.error).collect();
    assert!(errors.windows(2).all(|e| e[1] < e[0]), "{errors:?}");
    // what a governor asks
    let front = report.front("haptic.contact_stiffness_n_per_mm").unwrap();
    assert_eq!(front.within(f64::INFINITY), front.points.last().copied());
    assert_eq!(front.within(0.0), front.points.first().copied());
}
