//! Reads the last line of a training's `progress.csv`.

use std::collections::HashMap;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use perturb_files::open_plain;

/// Maximum length in bytes of the header and of every other line.
const MAX_LINE_BYTES: u64 = 16 * 1024;

/// The last line of a `progress.csv`: the progress of a training and the statistics of its last update.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LastProgress(HashMap<String, f64>);

impl LastProgress {
    /// Returns the value of a column, e.g. `rollout/episodes`; `None` if the column is empty or missing.
    pub fn get(&self, column: &str) -> Option<f64> {
        self.0.get(column).copied()
    }

    /// Returns the success rate of the last 100 training episodes, %.
    pub fn success_percent(&self) -> Option<f64> {
        self.get("rollout/success_rate").map(|rate| 100.0 * rate)
    }

    /// Returns the number of training episodes so far that count towards the budget.
    pub fn episodes(&self) -> Option<u64> {
        self.get("rollout/episodes").map(|episodes| episodes as u64)
    }
}

/// Reads the last complete line of the file at `path`. Returns `None` if there is none, or if its number of columns
/// differs from the header's. Only the beginning and the end of the file are read, so large files are fast too.
pub fn last_progress(path: &Path) -> Option<LastProgress> {
    let (mut file, metadata) = open_plain(path).ok()?;
    let length = metadata.len();
    let mut read = |from: u64| -> Option<String> {
        let mut bytes = Vec::new();
        file.seek(SeekFrom::Start(from)).ok()?;
        file.by_ref().take(MAX_LINE_BYTES).read_to_end(&mut bytes).ok()?;
        Some(String::from_utf8_lossy(&bytes).into_owned())
    };
    let beginning = read(0)?;
    let (names, first) = beginning.split_once('\n')?;
    let ending = if length > MAX_LINE_BYTES { read(length - MAX_LINE_BYTES)? } else { first.to_owned() };
    let whole = &ending[..ending.rfind('\n')?];
    let line = whole.rsplit('\n').next().unwrap_or_default();
    let number = |(name, text): (&str, &str)| Some((name.to_owned(), text.trim().parse().ok()?));
    let columns = names.trim().split(',');
    (line.split(',').count() == columns.clone().count())
        .then(|| LastProgress(columns.zip(line.split(',')).filter_map(number).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_whole_line_is_read_of_short_and_of_long_files() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("progress.csv");
        let read = |text: String| {
            std::fs::write(&path, text).unwrap();
            last_progress(&path).map(|last| (last.episodes(), last.success_percent()))
        };
        let names = "rollout/episodes,rollout/success_rate,train/std\n";
        assert_eq!(read(names.into()), None);
        assert_eq!(read(format!("{names}1,0.5,\n")), Some((Some(1), Some(50.0))));
        assert_eq!(read(format!("{names}1,0.5,\n2,0.7")), Some((Some(1), Some(50.0))), "half a line");
        assert_eq!(read(format!("{names}1,0.5\n")), None, "too few columns");
        assert_eq!(read(format!("{names}1,,x\n")), Some((Some(1), None)));
        let long: String = (0..5000).map(|line| format!("{line},0.25,0.125\n")).collect();
        assert_eq!(read(format!("{names}{long}")), Some((Some(4999), Some(25.0))));
        assert_eq!(last_progress(&directory.path().join("missing")), None);
    }
}
