//! Pages that need nothing from anywhere: style, charts and tables in one file.

use crate::{
    Report,
    chart::{bars, escaped, scatter},
    curve::number,
    effects::{EffectsReport, Measure},
    measure::MeasuredSubject,
    report::{MeasuredCurve, marks},
};
use std::fmt::Write as _;

const STYLE: &str = include_str!("page.css");

fn document(title: &str, body: &str) -> String {
    format!(
        "<!DOCTYPE html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>{}</title><style>{STYLE}</style></head><body><main>{body}</main></body></html>\n",
        escaped(title)
    )
}

/// The page of `maille tradeoff`.
pub(crate) fn tradeoff(report: &Report) -> String {
    let mut body = String::from("<h1>What accuracy costs in time</h1>");
    let _ = write!(
        body,
        "<p>Each point is a setting of a knob: its error against a truth, and the processor time of one thread as a ratio to the setting of <b>reference</b> \
         in the same rounds (bars: quartiles). Filled points are on the front: no other setting is better in both. Ringed points are the settings of \
         draft, balanced and reference.</p><p class=\"small\">{} run, {:.0} s, {}, load {:.1}. The whole of it: <code>maille tradeoff --{} -o DIR</code></p>",
        report.effort,
        report.took_s,
        escaped(&report.processor),
        report.load_1m,
        report.effort
    );
    overview(&mut body, report);
    body += "<nav>";
    for curve in &report.curves {
        let _ = write!(body, "<a href=\"#{0}\">{0}</a> ", curve.name);
    }
    body += "</nav>";
    for curve in &report.curves {
        section(&mut body, curve);
    }
    for cut in &report.cut_short {
        let _ = write!(body, "<p class=\"small\">Cut short: {}</p>", escaped(cut));
    }
    for skipped in &report.skipped {
        let _ = write!(body, "<p class=\"small\">Skipped: {}</p>", escaped(skipped));
    }
    document("maille: accuracy against time", &body)
}

/// The knobs that `accuracy` turns: error and time at its three words, on the first subject.
fn overview(body: &mut String, report: &Report) {
    if !report.curves.iter().any(|c| c.knob.is_some()) {
        return;
    }
    *body += "<h2>What <code>accuracy</code> chooses</h2><div class=\"scroll\"><table><thead><tr><th>knob</th><th>on</th>\
              <th class=\"n\">draft: error, time</th><th class=\"n\">balanced</th><th class=\"n\">reference</th><th>error in</th></tr></thead><tbody>";
    for curve in report.curves.iter().filter(|c| c.knob.is_some()) {
        let Some(subject) = curve.subjects.first() else { continue };
        let cell = |word: &str| {
            let point = subject.points.iter().find(|p| p.accuracy.contains(&word));
            point.map_or("–".into(), |p| format!("<b>{}</b>: {}, × {}", escaped(&p.label), number(p.error), number(p.ratio.median)))
        };
        let _ = write!(
            body,
            "<tr><td><a href=\"#{0}\">{0}</a></td><td>{1}</td><td class=\"n\">{2}</td><td class=\"n\">{3}</td><td class=\"n\">{4}</td><td>{5}</td></tr>",
            curve.name,
            escaped(&subject.subject),
            cell("draft"),
            cell("balanced"),
            cell("reference"),
            escaped(curve.unit)
        );
    }
    *body += "</tbody></table></div>";
}

fn section(body: &mut String, curve: &MeasuredCurve) {
    let _ = write!(
        body,
        "<section id=\"{0}\"><h2>{0}</h2><p>{1}.</p><dl><dt>error</dt><dd>{2} [{3}]</dd><dt>truth</dt><dd>{4}</dd><dt>timed</dt><dd>{5}</dd>\
         <dt>again</dt><dd><code>{6}</code></dd></dl>",
        curve.name,
        escaped(curve.title),
        escaped(curve.error),
        escaped(curve.unit),
        escaped(curve.truth),
        escaped(curve.timed),
        escaped(&curve.command)
    );
    if curve.defaults.is_none() {
        *body += "<p class=\"small\">No word of <code>accuracy</code> chooses here: a scene or an engine does.</p>";
    }
    for subject in &curve.subjects {
        let _ = write!(body, "<h3>{}</h3><div class=\"pair\"><figure>{}</figure>", escaped(&subject.subject), scatter(subject, curve.unit));
        table(body, subject, curve.unit);
        *body += "</div>";
        let m = &subject.monotone;
        if !m.holds {
            let breaks = m.breaks.iter().map(|b| escaped(b)).collect::<Vec<_>>().join("; ");
            let word = if m.expected { "Not monotone, which was not expected" } else { "Not monotone" };
            let _ = write!(body, "<p class=\"note\"><b>{word}:</b> {breaks}.");
            if let Some(why) = m.explanation {
                let _ = write!(body, " <b>Why:</b> {}.", escaped(why));
            }
            *body += "</p>";
        }
    }
    *body += "</section>";
}

fn table(body: &mut String, subject: &MeasuredSubject, unit: &str) {
    let lines = subject.points.iter().any(|p| !p.line.is_empty());
    let worst = subject.points.iter().any(|p| p.worst.is_some());
    *body += "<div class=\"scroll\"><table><thead><tr>";
    if lines {
        *body += "<th>line</th>";
    }
    let _ = write!(body, "<th>setting</th><th class=\"n\">error {}</th>", escaped(unit));
    if worst {
        *body += "<th class=\"n\">largest</th>";
    }
    *body += "<th class=\"n\">ms</th><th class=\"n\">ratio</th><th class=\"n\">quartiles</th><th></th></tr></thead><tbody>";
    for p in &subject.points {
        let _ = write!(body, "<tr{}>", if p.front { "" } else { " class=\"dim\"" });
        if lines {
            let _ = write!(body, "<td>{}</td>", escaped(p.line));
        }
        let _ = write!(body, "<td>{}</td><td class=\"n\">{}</td>", escaped(&p.label), number(p.error));
        if worst {
            let _ = write!(body, "<td class=\"n\">{}</td>", p.worst.map_or(String::new(), number));
        }
        let _ = write!(
            body,
            "<td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}–{}</td><td class=\"marks\">{}</td></tr>",
            number(p.time_ms.median),
            number(p.ratio.median),
            number(p.ratio.q1),
            number(p.ratio.q3),
            escaped(&marks(p))
        );
    }
    *body += "</tbody></table></div>";
}

/// The page of `maille effects`.
pub(crate) fn effects(report: &EffectsReport) -> String {
    let mut body = String::from("<h1>What effects cost</h1>");
    let _ = write!(
        body,
        "<p>The scene <b>{}</b> runs headless for {:.1} s with each effect and what it depends on, and without it; shown is the difference. An effect \
         that is not in a scene is in none of these figures: its stages do not exist.</p><p class=\"small\">{}, {} processors, load {:.1}. Again: \
         <code>{}</code></p>",
        escaped(&report.scene),
        report.duration_s,
        escaped(&report.processor),
        report.processors,
        report.load_1m,
        escaped(&report.command)
    );
    body += "<h2>Added by each effect</h2><div class=\"scroll\">";
    body += &effects_table(report);
    body += "</div><div class=\"charts\">";
    let rows = |of: fn(&Measure) -> (f64, Option<f64>)| -> Vec<(String, f64, Option<f64>)> {
        report
            .effects
            .iter()
            .filter_map(|e| e.added.as_ref().map(|a| (e.effect.clone(), of(a))))
            .filter(|(_, (v, _))| !v.is_nan())
            .map(|(n, (v, u))| (n, v, u))
            .collect()
    };
    for (title, unit, of) in [
        ("a tick, added (p50)", "µs", (|m: &Measure| (m.tick_us.p50, Some(m.tick_us.p99))) as fn(&Measure) -> (f64, Option<f64>)),
        ("a step, added (p50)", "µs", |m| (m.step_us.p50, Some(m.step_us.p99))),
        ("a frame, added (p50)", "ms", |m| (m.frame_ms.p50, Some(m.frame_ms.p99))),
        ("shared memory, added", "MiB", |m| (m.segments_mib, None)),
        ("private memory, added", "MiB", |m| (m.private_mib, None)),
    ] {
        let _ = write!(body, "<figure>{}</figure>", bars(title, unit, &rows(of)));
    }
    body += "</div><h2>The runs themselves</h2><div class=\"scroll\">";
    body += &runs_table(report);
    body += "</div>";
    document("maille: what effects cost", &body)
}

fn signed(v: f64) -> String {
    if v >= 0.0 { format!("+{}", number(v)) } else { number(v).replace('-', "−") }
}

fn effects_table(report: &EffectsReport) -> String {
    let mut out = String::from(
        "<table><thead><tr><th>effect</th><th>compared with</th><th class=\"n\">tick µs p50, p99</th><th class=\"n\">step µs p50, p99</th>\
         <th class=\"n\">frame ms p50, p99</th><th class=\"n\">shared MiB</th><th class=\"n\">private MiB</th><th>processes</th></tr></thead><tbody>",
    );
    for e in &report.effects {
        let _ = write!(out, "<tr><td>{}</td><td>{}</td>", escaped(&e.effect), escaped(&e.over.join(" + ")));
        match &e.added {
            None => {
                let _ = write!(out, "<td colspan=\"6\">{}</td></tr>", escaped(e.note.as_deref().unwrap_or("not measured")));
            }
            Some(a) => {
                let pair =
                    |p: &crate::effects::Pair| if p.p50.is_nan() { "–".into() } else { format!("{}, {}", signed(p.p50), signed(p.p99)) };
                let _ = write!(
                    out,
                    "<td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td>{}</td></tr>",
                    pair(&a.tick_us),
                    pair(&a.step_us),
                    pair(&a.frame_ms),
                    signed(a.segments_mib),
                    signed(a.private_mib),
                    escaped(&e.processes_added.join(", "))
                );
                if let Some(note) = &e.note {
                    let _ = write!(out, "<tr class=\"dim\"><td></td><td colspan=\"7\">{}</td></tr>", escaped(note));
                }
            }
        }
    }
    out + "</tbody></table>"
}

fn runs_table(report: &EffectsReport) -> String {
    let mut out = String::from(
        "<table><thead><tr><th>effects on</th><th class=\"n\">tick µs p50, p99</th><th class=\"n\">step µs p50, p99</th>\
         <th class=\"n\">frame ms p50, p99</th><th class=\"n\">shared MiB</th><th class=\"n\">private MiB</th><th>processes</th></tr></thead><tbody>",
    );
    for run in &report.runs {
        let pair = |p: &crate::effects::Pair| {
            if p.p50.is_nan() || p.p50 == 0.0 && p.p99 == 0.0 { "–".into() } else { format!("{}, {}", number(p.p50), number(p.p99)) }
        };
        let m = &run.measure;
        let on = if run.effects.is_empty() { "view".into() } else { format!("view + {}", run.effects.join(" + ")) };
        let _ = write!(
            out,
            "<tr><td>{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td>{}</td></tr>",
            escaped(&on),
            pair(&m.tick_us),
            pair(&m.step_us),
            pair(&m.frame_ms),
            number(m.segments_mib),
            number(m.private_mib),
            escaped(&run.processes.join(", "))
        );
    }
    out + "</tbody></table>"
}
