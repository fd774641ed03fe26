//! Traces from Varian RPM files (`.vxp`): `[Header]` of KEY=VALUE, then `[Data]` of comma-separated rows in the header's layout.
//!
//! Amplitudes are in the recorder's unit (cm) times `Scale_factor`: millimetres. Times are milliseconds. A negative valid flag says that
//! the recorder could not tell the phase there (irregular breathing); the amplitude is measured all the same, so the row is kept and
//! counted. The recorder's own phase is not used: the cycles are found in the amplitude (`super::cycles`).

use super::trace::{SignalError, Trace};

impl Trace {
    /// Reads an RPM file.
    ///
    /// # Errors
    /// One sentence with file and line when a part is missing or a row is broken.
    pub fn from_vxp(text: &str, name: &str) -> Result<Self, SignalError> {
        let mut layout = vec!["amplitude".to_string(), "phase".into(), "timestamp".into(), "validflag".into()];
        let (mut scale, mut section) = (None, "");
        let (mut rows, mut dropped, mut irregular) = (Vec::new(), 0, 0);
        for (line, row) in text.trim_start_matches('\u{feff}').lines().enumerate().map(|(n, l)| (n + 1, l.trim())) {
            let fail = |fault: String| SignalError::line(name, line, fault);
            match row {
                "" => {}
                "[Header]" | "[Data]" => section = row,
                _ if section == "[Header]" => {
                    let (key, value) = row.split_once('=').ok_or_else(|| fail(format!("{row:?} is no KEY=VALUE of a header")))?;
                    match key.trim().to_lowercase().as_str() {
                        "data_layout" => layout = value.split(',').map(|c| c.trim().to_lowercase()).collect(),
                        "scale_factor" => {
                            let parsed = value.trim().parse::<f64>().ok().filter(|s| s.is_finite() && *s > 0.0);
                            scale = Some(parsed.ok_or_else(|| fail(format!("scale factor {value:?} is no positive number")))?);
                        }
                        _ => {}
                    }
                }
                _ if section == "[Data]" => {
                    let cells: Vec<&str> = row.split(',').map(str::trim).collect();
                    let cell = |wanted: &str| layout.iter().position(|c| c == wanted).and_then(|c| cells.get(c)).copied();
                    let (Some(amplitude), Some(time)) = (cell("amplitude"), cell("timestamp")) else {
                        return Err(fail(format!(
                            "no amplitude and timestamp in {} columns; the layout is {}",
                            cells.len(),
                            layout.join(",")
                        )));
                    };
                    match (amplitude.parse::<f64>(), time.parse::<f64>()) {
                        (Ok(amplitude), Ok(time)) => {
                            irregular += usize::from(cell("validflag").and_then(|f| f.parse::<i32>().ok()).is_some_and(|f| f < 0));
                            rows.push((time * 1e-3, amplitude * scale.unwrap_or(10.0)));
                        }
                        _ => dropped += 1,
                    }
                }
                _ => return Err(fail("neither [Header] nor [Data] has begun: this is no RPM file".into())),
            }
        }
        if rows.is_empty() {
            return Err(SignalError::file(name, "no [Data]: the file is empty or cut off"));
        }
        let mut trace = Self::new(name, rows)?;
        trace.dropped_rows += dropped;
        trace.irregular_rows = irregular;
        Ok(trace)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layout_scale_and_flags_are_followed() {
        let mut text = String::from("[Header]\r\nVersion=1.6\r\nData_layout=timestamp,amplitude,validflag\r\nScale_factor=5\r\n[Data]\r\n");
        for n in 0..50 {
            text += &format!("{},{:.3},{}\r\n", 1000 + 40 * n, (f64::from(n) * 0.1).sin(), if n < 10 { -2 } else { 0 });
        }
        text += "nonsense,,0\r\n";
        let trace = Trace::from_vxp(&text, "p.vxp").unwrap();
        assert_eq!((trace.values.len(), trace.irregular_rows, trace.dropped_rows), (50, 10, 1));
        assert!((trace.values[1] - 0.5).abs() < 0.01 && (trace.times_s[1] - 0.04).abs() < 1e-9);
        assert!(Trace::from_vxp("[Header]\nScale_factor=-1\n", "p.vxp").unwrap_err().to_string().starts_with("p.vxp:2:"));
        assert!(Trace::from_vxp("1,2,3", "p.vxp").unwrap_err().to_string().starts_with("p.vxp:1:"));
        assert!(Trace::from_vxp("[Data]\n1\n", "p.vxp").unwrap_err().to_string().contains("p.vxp:2: no amplitude"));
        assert!(Trace::from_vxp("[Data]\n", "p.vxp").is_err());
    }
}
