//! Traces from tables of text: comma, semicolon, tab or blank between columns, decimal points or commas, with or without a header.
//!
//! The separator is the first of `;`, tab, `,` and blanks that splits the first sample into two columns or more; a comma is decimal
//! wherever it does not separate. Time is the column of that name, else the first whose header has "time", else the first; it is in
//! milliseconds when its header says so or when samples lie 2 or more apart (nothing slower than that shows breathing in seconds). Columns named frame, index or sample
//! are no values. Of several value columns the signal is their first principal axis (a marker moves along one line in space), signed
//! so that it dwells at its low end, where breathing rests; rows in which a coordinate was lost or leaps are left out before (`super::axis`).
//!
//! Rows that are all zeros, or whose cells are empty or no numbers though the table's are, are dropouts; a row with too few columns
//! or a broken header is an error that names the line.

use super::axis::along_principal_axis;
use super::trace::{SignalError, Trace, quantile};

/// Which columns to read, where the table itself does not say.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CsvOptions {
    /// header or number (from 1) of the column of times
    pub time_column: Option<String>,
    /// header or number (from 1) of the column of values; all of them when absent
    pub value_column: Option<String>,
    /// seconds a unit of time (0.001 for milliseconds); told from the table when absent
    pub time_unit_s: Option<f64>,
}

impl Trace {
    /// Reads a table.
    ///
    /// # Errors
    /// One sentence with file and line when it is no table of samples.
    pub fn from_csv(text: &str, name: &str, options: &CsvOptions) -> Result<Self, SignalError> {
        let lines: Vec<(usize, &str)> = text
            .trim_start_matches('\u{feff}')
            .lines()
            .enumerate()
            .map(|(n, l)| (n + 1, l.trim()))
            .filter(|(_, l)| !l.is_empty() && !l.starts_with('#'))
            .collect();
        let first = lines.iter().position(|(_, l)| l.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c)));
        let first = first.ok_or_else(|| SignalError::file(name, "no line begins with a number: this is no table of samples"))?;
        let separator = Separator::of(lines[first].1)
            .ok_or_else(|| SignalError::line(name, lines[first].0, "one column only; a time and a value are needed"))?;
        let width = separator.split(lines[first].1).len();
        let header: Vec<String> = match first {
            0 => vec![String::new(); width],
            n => separator.split(lines[n - 1].1).iter().map(|h| h.trim_matches('"').trim().to_lowercase()).collect(),
        };
        if header.len() != width {
            let fault = format!("the header has {} columns, the first sample {width}", header.len());
            return Err(SignalError::line(name, lines[first - 1].0, fault));
        }
        let find = |wanted: &str| {
            let by_name = header.iter().position(|h| *h == wanted.trim().to_lowercase());
            by_name.or_else(|| wanted.trim().parse::<usize>().ok().filter(|n| (1..=width).contains(n)).map(|n| n - 1)).ok_or_else(|| {
                SignalError::line(name, lines[first.max(1) - 1].0, format!("no column {wanted:?}; there are {}", header.join(", ")))
            })
        };
        let time = match &options.time_column {
            Some(wanted) => find(wanted)?,
            None => header.iter().position(|h| h.contains("time")).unwrap_or(0),
        };
        let counts = |h: &String| ["frame", "index", "sample", "id"].contains(&h.as_str());
        let values: Vec<usize> = match &options.value_column {
            Some(wanted) => vec![find(wanted)?],
            None => (0..width).filter(|&c| c != time && !counts(&header[c])).collect(),
        };
        if values.is_empty() {
            return Err(SignalError::line(name, lines[first].0, "no column of values beside the time"));
        }

        // every row as numbers; NaN where a cell is none
        let mut rows: Vec<(f64, Vec<f64>)> = Vec::new();
        let mut dropped = 0;
        for &(line, row) in &lines[first..] {
            let cells = separator.split(row);
            if cells.len() < width {
                return Err(SignalError::line(name, line, format!("{} columns instead of {width}", cells.len())));
            }
            let number = |c: usize| separator.number(cells[c]);
            let row: Vec<f64> = values.iter().map(|&c| number(c)).collect();
            // a lone zero may be a value; a zero time beside it, or zeros in every column, is a sensor that saw nothing. Where a recording begins, it may
            // be the place that all is measured from: whether it is, the other rows say (`super::axis`)
            let nothing = row.iter().all(|v| *v == 0.0) && (row.len() > 1 || number(time) == 0.0) && !rows.is_empty();
            if nothing || row.iter().any(|v| !v.is_finite()) || !number(time).is_finite() {
                dropped += 1;
            } else {
                rows.push((number(time), row));
            }
        }
        if rows.is_empty() {
            return Err(SignalError::file(name, format!("none of {dropped} rows is a sample")));
        }
        let unit = options.time_unit_s.unwrap_or_else(|| guess_unit(&header[time], &rows));
        let along = along_principal_axis(rows);
        let mut trace = Self::new(name, along.rows.into_iter().map(|(t, v)| (t * unit, v)))?;
        trace.dropped_rows += dropped + along.zeros;
        trace.outlier_rows += along.spikes;
        Ok(trace)
    }
}

fn guess_unit(header: &str, rows: &[(f64, Vec<f64>)]) -> f64 {
    if header.contains("ms") || header.contains("milli") {
        return 1e-3;
    }
    let step = quantile(rows.windows(2).map(|w| w[1].0 - w[0].0).collect(), 0.5);
    if step >= 2.0 && !header.contains("(s)") { 1e-3 } else { 1.0 }
}

#[derive(Clone, Copy)]
enum Separator {
    Char(char),
    Blank,
}

impl Separator {
    fn of(line: &str) -> Option<Self> {
        let all = [Self::Char(';'), Self::Char('\t'), Self::Char(','), Self::Blank];
        all.into_iter().find(|s| s.split(line).len() > 1)
    }
    fn split<'a>(&self, line: &'a str) -> Vec<&'a str> {
        match self {
            Self::Char(c) => line.split(*c).map(str::trim).collect(),
            Self::Blank => line.split_whitespace().collect(),
        }
    }
    /// NaN for what is no number.
    fn number(&self, cell: &str) -> f64 {
        let cell = cell.trim_matches('"').trim();
        let parsed = match self {
            Self::Char(',') => cell.parse(),
            _ => cell.replace(',', ".").parse(),
        };
        parsed.unwrap_or(f64::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(separator: &str, comma: bool) -> String {
        let mut text = format!("\"Frame\"{separator}\"Timestamp\"{separator}\"x\"{separator}\"y\"\r\n");
        for n in 0..60 {
            let s = (f64::from(n) * 0.15).sin().max(-0.5);
            let row = format!("{n}{separator}{}{separator}{:.2}{separator}{:.2}\r\n", n * 100, 3.0 * s - 400.0, 4.0 * s + 2.0);
            text += &if comma { row.replace('.', ",") } else { row };
        }
        text + &format!("0{separator}0{separator}0{separator}0\r\n")
    }

    #[test]
    fn every_dialect_reads_the_same_samples() {
        let reference = Trace::from_csv(&table(";", true), "a.csv", &CsvOptions::default()).unwrap();
        assert_eq!((reference.values.len(), reference.dropped_rows), (60, 1));
        assert!((reference.period_s() - 0.1).abs() < 1e-12);
        for text in [table(";", false), table("\t", true), table(",", false)] {
            assert_eq!(Trace::from_csv(&text, "a.csv", &CsvOptions::default()).unwrap(), reference);
        }
        // the marker moves along (3, 4)/5: the signal is 5·s, and it dwells at the low end
        let span = quantile(reference.values.clone(), 1.0) - quantile(reference.values.clone(), 0.0);
        assert!((span - 5.0 * 1.5).abs() < 0.05, "{span}");
        let x = Trace::from_csv(&table(";", true), "a.csv", &CsvOptions { value_column: Some("X".into()), ..Default::default() }).unwrap();
        assert!((x.values[0] + 400.0).abs() < 1e-9);
    }

    #[test]
    fn faults_name_file_and_line() {
        let broken = table(";", true).replace("7;700;", "7;");
        let message = Trace::from_csv(&broken, "b.csv", &CsvOptions::default()).unwrap_err().to_string();
        assert!(message.starts_with("b.csv:9: 3 columns"), "{message}");
        let options = CsvOptions { value_column: Some("z".into()), ..Default::default() };
        assert!(Trace::from_csv(&table(";", true), "b.csv", &options).unwrap_err().to_string().contains("b.csv:1: no column \"z\""));
        assert!(Trace::from_csv("hello\nworld", "c.csv", &CsvOptions::default()).unwrap_err().to_string().contains("c.csv: no line"));
        assert!(Trace::from_csv("", "d.csv", &CsvOptions::default()).is_err());
    }
}
