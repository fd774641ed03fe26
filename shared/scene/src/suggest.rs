//! "Did you mean": the nearest of a list of words, by edit distance.

/// Number of insertions, deletions, substitutions and swaps of neighbours that turn one word into the other (optimal
/// string alignment).
fn distance(a: &str, b: &str) -> usize {
    let (a, b): (Vec<char>, Vec<char>) = (a.chars().collect(), b.chars().collect());
    let mut d = vec![vec![0; b.len() + 1]; a.len() + 1];
    for (i, row) in d.iter_mut().enumerate() {
        row[0] = i;
    }
    for (j, cell) in d[0].iter_mut().enumerate() {
        *cell = j;
    }
    for i in 1..=a.len() {
        for j in 1..=b.len() {
            let cost = usize::from(a[i - 1] != b[j - 1]);
            d[i][j] = (d[i - 1][j] + 1).min(d[i][j - 1] + 1).min(d[i - 1][j - 1] + cost);
            if i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1] {
                d[i][j] = d[i][j].min(d[i - 2][j - 2] + 1);
            }
        }
    }
    d[a.len()][b.len()]
}

/// The candidate that was most likely meant, if any is near: at most a third of the word wrong, or one a prefix of the
/// other (`threshold` for `threshold_hu`).
pub fn nearest<'a>(word: &str, candidates: &[&'a str]) -> Option<&'a str> {
    let lower = word.to_lowercase().replace('-', "_");
    candidates
        .iter()
        .map(|&c| {
            let c_lower = c.to_lowercase().replace('-', "_");
            let related = lower.len() >= 3 && (c_lower.starts_with(&lower) || lower.starts_with(&c_lower));
            let d = distance(&lower, &c_lower);
            (if related { d.min(1) } else { d }, c)
        })
        .min_by_key(|&(d, _)| d)
        .filter(|&(d, c)| d <= (c.chars().count().max(word.chars().count()) / 3).max(1))
        .map(|(_, c)| c)
}

/// One sentence: what is unknown, what was meant or what there is.
pub fn unknown(what: &str, word: &str, candidates: &[&str]) -> String {
    match nearest(word, candidates) {
        Some(near) => format!("unknown {what} `{word}`, did you mean `{near}`?"),
        None => format!("unknown {what} `{word}`; there is {}", candidates.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slip_of_the_finger_is_recognised_and_another_word_is_not() {
        let keys = ["threshold_hu", "bone_hu", "offset", "rate_hz"];
        assert_eq!(nearest("treshold_hu", &keys), Some("threshold_hu"));
        assert_eq!(nearest("threshold", &keys), Some("threshold_hu"));
        assert_eq!(nearest("rate-hz", &keys), Some("rate_hz"));
        assert_eq!(nearest("colour", &keys), None);
        assert_eq!(distance("ab", "ba"), 1);
        assert_eq!(distance("", "abc"), 3);
    }
}
