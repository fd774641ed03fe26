//! Points that somebody marked in an image, from the files they come in.
//!
//! - Text as elastix and transformix have it: `point` (LPS mm) or `index` (voxels from 0), how many, then a row of three numbers each. The word is what tells
//!   millimetres from voxels, so a file without it is refused.
//! - MATLAB (version 5, compressed or not) as in the sets made from DIR-Lab's: the variable asked for, n × 3, voxels from 1 as [y, x, z].
//!
//! Voxels are those of the grid that the caller names. Given: patient mm, LPS, in the file's order. Not here: files, and whose points belong together
//! (rows of two lists do).

mod mat;

use maille_volume::Grid;

/// Points [mm, LPS] from a file's bytes; `variable` names one of a MATLAB file.
///
/// # Errors
/// One sentence that says what is wrong, without the file's name.
pub fn points(bytes: &[u8], variable: Option<&str>, grid: &Grid) -> Result<Vec<[f64; 3]>, String> {
    let found = if bytes.starts_with(b"MATLAB 5.0") {
        let voxels = mat::rows_of_three(bytes, variable)?;
        voxels.into_iter().map(|[y, x, z]| grid.world_from_index([x, y, z].map(|v| v - 1.0))).collect()
    } else if let Some(variable) = variable {
        return Err(format!("it is no MATLAB file of version 5, so it has no variable `{variable}`"));
    } else {
        text(bytes, grid)?
    };
    let found: Vec<[f64; 3]> = found;
    match found.iter().position(|p| !p.iter().all(|c| c.is_finite())) {
        _ if found.is_empty() => Err("it holds no points".into()),
        Some(n) => Err(format!("point {} is not finite", n + 1)),
        None => Ok(found),
    }
}

fn text(bytes: &[u8], grid: &Grid) -> Result<Vec<[f64; 3]>, String> {
    let text = String::from_utf8_lossy(bytes);
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty());
    let advice =
        "begin it with a line `point` (patient mm, LPS) or `index` (voxels from 0), then how many, then a row of three numbers each";
    let voxels = match lines.next().map(|(_, l)| l.trim()) {
        Some("point") => false,
        Some("index") => true,
        _ => return Err(format!("nothing says what its numbers are; {advice}")),
    };
    let count: usize =
        lines.next().and_then(|(_, l)| l.trim().parse().ok()).ok_or_else(|| format!("its second line is no number of points; {advice}"))?;
    let row = |(n, line): (usize, &str)| {
        let numbers: Option<Vec<f64>> = line.split_whitespace().map(|v| v.parse::<f64>().ok()).collect();
        match numbers.as_deref() {
            Some(&[x, y, z]) => Ok(if voxels { grid.world_from_index([x, y, z]) } else { [x, y, z] }),
            _ => Err(format!("line {}: `{}` is not a row of three numbers", n + 1, line.trim())),
        }
    };
    let points: Vec<[f64; 3]> = lines.map(row).collect::<Result<_, _>>()?;
    if points.len() == count { Ok(points) } else { Err(format!("it says {count} points and holds {}", points.len())) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn millimetres_and_voxels_are_told_apart_by_the_word() {
        let mut grid = Grid::axis_aligned([10; 3], [2.0, 2.0, 3.0]);
        grid.origin = [-7.0, 1.0, 0.5];
        let of = |text: &str| points(text.as_bytes(), None, &grid);
        assert_eq!(of("point\n2\n1 2 3\n-4.5 5e1 6\n").unwrap(), [[1.0, 2.0, 3.0], [-4.5, 50.0, 6.0]]);
        assert_eq!(of("index\r\n1\r\n1 2 3\r\n").unwrap(), [[-5.0, 5.0, 9.5]]);
        for (text, says) in [
            ("1 2 3\n", "nothing says"),
            ("point\n1 2 3\n", "second line"),
            ("point\n2\n1 2 3\n", "says 2 points and holds 1"),
            ("point\n1\n1 2\n", "line 3"),
            ("point\n1\n1 2 nan\n", "not finite"),
            ("point\n0\n", "no points"),
            ("", "nothing says"),
        ] {
            let fault = of(text).unwrap_err();
            assert!(fault.contains(says), "{text:?}: {fault}");
        }
        assert!(points(b"point\n0\n", Some("a"), &grid).unwrap_err().contains("no MATLAB file"));
    }
}
