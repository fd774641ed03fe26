//! A recording: the tool's way with the force that the hand got, a line a moment, as comma-separated values.
//!
//! Written while a scene with the effect `recording` runs, and way points again for `--device path:FILE.csv`: what is played goes to where the
//! tip was at each time, forces are left to the contact. Columns ([`COLUMNS`]): simulation time s, tip mm (LPS), direction (unit, shaft to tip),
//! force on the hand N, 1 while it touches. Lines that begin with `#` say something to people.

use crate::tool::PathPoint;

/// First line that is no comment.
pub const COLUMNS: &str = "time_s,x_mm,y_mm,z_mm,dx,dy,dz,fx_n,fy_n,fz_n,touches";
/// Where a scene's recording goes that says nothing else, in the working directory.
pub const FILE: &str = "maille-recording.csv";

/// A moment.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moment {
    /// simulation time [s]
    pub time_s: f64,
    /// tip's centre, in the world [mm, LPS]
    pub tip_mm: [f64; 3],
    /// unit vector, shaft to tip
    pub direction: [f64; 3],
    /// on the hand [N]
    pub force_n: [f64; 3],
    /// whether it touches tissue
    pub touches: bool,
}

impl Moment {
    /// Its line, without the line's end: microseconds, nanometres, millionths of a newton.
    pub fn line(&self) -> String {
        let [x, y, z] = self.tip_mm;
        let [u, v, w] = self.direction;
        let [f, g, h] = self.force_n;
        format!("{:.6},{x:.6},{y:.6},{z:.6},{u:.6},{v:.6},{w:.6},{f:.6},{g:.6},{h:.6},{}", self.time_s, u8::from(self.touches))
    }

    /// From its line; what is wrong with it.
    ///
    /// # Errors
    /// When there are not as many numbers as [`COLUMNS`] has.
    pub fn of_line(line: &str) -> Result<Self, String> {
        let numbers: Vec<f64> = line
            .split(',')
            .map(|word| word.trim().parse::<f64>().ok().filter(|v| v.is_finite()).ok_or(format!("`{}` is not a number", word.trim())))
            .collect::<Result<_, _>>()?;
        let &[time_s, x, y, z, u, v, w, f, g, h, touches] = &numbers[..] else {
            return Err(format!("{} columns, and a recording has {}: {COLUMNS}", numbers.len(), COLUMNS.split(',').count()));
        };
        Ok(Self { time_s, tip_mm: [x, y, z], direction: [u, v, w], force_n: [f, g, h], touches: touches != 0.0 })
    }
}

/// The moments of a recording; the number of the line that is wrong, from 1, and why. A last line that is not whole (its writer died) is left out.
///
/// # Errors
/// When it is no recording.
pub fn read(text: &str) -> Result<Vec<Moment>, (usize, String)> {
    let whole = text.ends_with('\n');
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.starts_with('#') && !line.trim().is_empty()).peekable();
    match lines.next() {
        Some((_, columns)) if columns.trim() == COLUMNS => {}
        first => return Err((first.map_or(1, |(n, _)| n + 1), format!("a recording begins with its columns: {COLUMNS}"))),
    }
    let mut moments: Vec<Moment> = Vec::new();
    while let Some((n, line)) = lines.next() {
        if lines.peek().is_none() && !whole {
            break;
        }
        let moment = Moment::of_line(line).map_err(|why| (n + 1, why))?;
        if moments.last().is_some_and(|last| last.time_s >= moment.time_s) {
            return Err((n + 1, format!("{} s is not after the line before it", moment.time_s)));
        }
        moments.push(moment);
    }
    Ok(moments)
}

/// Its way points.
pub fn way(moments: &[Moment]) -> Vec<PathPoint> {
    let direction = |d: [f64; 3]| d.iter().any(|v| *v != 0.0).then_some(d);
    moments.iter().map(|m| PathPoint { time_s: m.time_s, mm: Some(m.tip_mm), fraction: None, direction: direction(m.direction) }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moment(n: usize) -> Moment {
        let t = n as f64 * 0.01;
        Moment {
            time_s: t,
            tip_mm: [t.sin() * 30.0, -80.0 + t, 4.0],
            direction: [0.0, 0.6, 0.8],
            force_n: [0.0, -t, 0.5],
            touches: n % 2 == 1,
        }
    }

    fn text(count: usize) -> String {
        let lines: Vec<String> = (0..count).map(|n| moment(n).line() + "\n").collect();
        format!("# a run\n{COLUMNS}\n{}", lines.concat())
    }

    #[test]
    fn a_recording_is_read_as_it_was_written_up_to_its_last_whole_line() {
        let text = text(300);
        let read_back = read(&text).unwrap();
        assert_eq!(read_back.len(), 300);
        for (n, read) in read_back.iter().enumerate() {
            let true_one = moment(n);
            assert_eq!(read.touches, true_one.touches);
            let pairs = [(read.tip_mm, true_one.tip_mm), (read.direction, true_one.direction), (read.force_n, true_one.force_n)];
            // half of the last digit
            assert!(pairs.iter().all(|(a, b)| (0..3).all(|c| (a[c] - b[c]).abs() <= 0.5001e-6)), "{n}");
        }
        // a writer that died within a line
        assert_eq!(read(&text[..text.len() - 7]).unwrap().len(), 299);
        assert_eq!(way(&read_back)[7].mm, Some(read_back[7].tip_mm));
    }

    #[test]
    fn what_is_no_recording_is_refused_at_its_line() {
        assert_eq!(read("time,x\n1,2\n").unwrap_err().0, 1);
        assert_eq!(read("").unwrap_err().0, 1);
        let good = text(3);
        assert!(read(&format!("{good}0.5,1,2\n")).unwrap_err().1.contains("3 columns"));
        assert!(read(&format!("{good}{}\n", moment(1).line())).unwrap_err().1.contains("not after"));
        let (line, why) = read(&good.replace("0.600000", "nan")).unwrap_err();
        assert!(line == 3 && why.contains("`nan`"), "{line} {why}");
    }
}
