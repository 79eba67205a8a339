//! The learning curve of a training. It is read from `monitor.csv` while that file grows, and has at most 160 points.

use perturb_text::shortened;
use serde::Serialize;

use crate::tail::{MAX_READ_BYTES, Tail, TailUpdate};

/// Maximum number of groups of episodes in memory. When it is exceeded, pairs of groups are merged.
const MAX_GROUPS: usize = 512;
/// Maximum number of points of a curve.
const MAX_POINTS: usize = 160;
/// Minimum number of episodes that a point averages. The last point may average fewer.
const MIN_EPISODES_PER_POINT: usize = 10;
/// Minimum time over which a speed is measured, in seconds.
const MIN_SPEED_SECONDS: f64 = 1.0;
/// Maximum number of different speeds in a curve.
const MAX_SPEEDS: f64 = 40.0;
/// Consecutive parts of the curve count as written to the log at once if the times of their last episodes differ by
/// less than this. The value is a fraction of the time over which the speed is measured.
const SAME_BLOCK_SHARE: f64 = 0.02;

/// The episodes of a growing log, summed up in groups.
#[derive(Debug)]
pub(crate) struct EpisodeLog {
    tail: Tail,
    /// Positions of the columns with return, length, time and success; `None` before the header was read.
    columns: Option<[usize; 4]>,
    groups: Vec<EpisodeGroup>,
    /// Number of episodes in each group. The last group may have fewer.
    group_size: usize,
    /// Number of lines that were read, without empty lines.
    lines: usize,
    /// The error of the first line that could not be parsed, or of a line that is too long to be read.
    line_fault: Option<String>,
    /// The reason why the file could not be read at the last attempt.
    read_error: Option<String>,
}

/// Sums over consecutive episodes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct EpisodeGroup {
    episodes: usize,
    episode_return: f64,
    steps: f64,
    successes: f64,
    /// Time of the last episode, in seconds since the start of the training.
    end: f64,
}

/// The points of a learning curve. Each list has one number per point. A point stands for consecutive episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(crate) struct LearningCurve {
    /// x coordinates in episodes: the number of episodes before the point, plus half of the point's episodes.
    pub(crate) episodes: Vec<f64>,
    /// x coordinates in steps: the number of steps before the point, plus half of the point's steps. Steps are those of
    /// all environments together.
    pub(crate) steps: Vec<f64>,
    /// Mean undiscounted return; `None` if it is not finite.
    #[serde(rename = "return")]
    pub(crate) episode_return: Vec<Option<f64>>,
    /// Success rate, in percent.
    pub(crate) success: Vec<f64>,
    /// Mean length of episodes, in steps.
    pub(crate) length: Vec<f64>,
    /// Steps per second; `None` if it is not known yet.
    pub(crate) speed: Vec<Option<f64>>,
    /// Number of episodes of each point. The last point may have a different number.
    #[serde(rename = "each")]
    pub(crate) episodes_per_point: usize,
}

impl EpisodeLog {
    /// Makes an empty log that reads the file at `path`, which need not exist yet.
    pub(crate) fn new(path: &std::path::Path) -> Self {
        Self {
            tail: Tail::new(path),
            columns: None,
            groups: Vec::new(),
            group_size: 1,
            lines: 0,
            line_fault: None,
            read_error: None,
        }
    }

    /// Reads the episodes that were added to the file. Returns whether anything has changed.
    pub(crate) fn read_new(&mut self) -> bool {
        let new = match self.tail.read_new() {
            Ok(TailUpdate::Unchanged) => return self.read_error.take().is_some(),
            Ok(TailUpdate::Appended(new)) => new,
            Ok(TailUpdate::Restarted(new)) => {
                self.columns = None;
                self.groups.clear();
                self.group_size = 1;
                self.lines = 0;
                self.line_fault = None;
                new
            }
            Ok(TailUpdate::LineTooLong) => {
                let line = self.lines + 1;
                let limit = MAX_READ_BYTES >> 20;
                self.line_fault = Some(format!("line {line} is longer than {limit} MiB; nothing after it is read"));
                return true;
            }
            Err(error) => {
                let read_error = Some(format!("it cannot be read: {error}"));
                return std::mem::replace(&mut self.read_error, read_error.clone()) != read_error;
            }
        };
        self.read_error = None;
        for line in new.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
            self.lines += 1;
            if let Err(reason) = self.add_line(&String::from_utf8_lossy(line)) {
                self.line_fault.get_or_insert(format!("line {}: {reason}", self.lines));
            }
        }
        true
    }

    /// Returns the number of episodes that were read.
    pub(crate) fn episode_count(&self) -> usize {
        self.groups.iter().map(|group| group.episodes).sum()
    }

    /// Returns the mean length of episodes in steps and the speed in steps per second. Both are measured over the last
    /// tenth of the training time, but at least over [`MIN_SPEED_SECONDS`]. Returns `None` if they are not known yet.
    pub(crate) fn recent(&self) -> Option<(f64, f64)> {
        let end = self.groups.last()?.end;
        let is_old = |group: &EpisodeGroup| end - group.end >= MIN_SPEED_SECONDS.max(end / 10.0);
        let first = self.groups.iter().rposition(is_old).map_or(0, |before| before + 1);
        let recent = EpisodeGroup::sum(&self.groups[first..]);
        let start = first.checked_sub(1).map_or(0.0, |before| self.groups[before].end);
        let length = recent.steps / recent.episodes as f64;
        let speed = recent.steps / (recent.end - start);
        (length > 0.0 && speed > 0.0 && speed.is_finite()).then_some((length, speed))
    }

    /// Returns an error message if the file could not be read, or a line could not be parsed.
    pub(crate) fn fault(&self) -> Option<&str> {
        self.read_error.as_deref().or(self.line_fault.as_deref())
    }

    fn add_line(&mut self, line: &str) -> Result<(), String> {
        if line.starts_with('#') {
            return Ok(());
        }
        let fields: Vec<&str> = line.trim_end().split(',').collect();
        let Some(columns) = self.columns else {
            let position = |name: &str| {
                fields.iter().position(|field| *field == name).ok_or_else(|| format!("there is no column `{name}`"))
            };
            self.columns = Some([position("r")?, position("l")?, position("t")?, position("success")?]);
            return Ok(());
        };
        let number = |column: usize| {
            let text = fields.get(column).copied().unwrap_or_default();
            text.parse::<f64>().map_err(|_| format!("`{}` is not a number", shortened(text)))
        };
        let [episode_return, steps, end, successes] = columns.map(number);
        self.add(EpisodeGroup {
            episodes: 1,
            episode_return: episode_return?,
            steps: steps?,
            successes: successes?,
            end: end?,
        });
        Ok(())
    }

    fn add(&mut self, episode: EpisodeGroup) {
        match self.groups.last_mut() {
            Some(last) if last.episodes < self.group_size => last.add(&episode),
            _ => self.groups.push(episode),
        }
        if self.groups.len() > MAX_GROUPS {
            self.groups = self.groups.chunks(2).map(EpisodeGroup::sum).collect();
            self.group_size *= 2;
        }
    }

    /// Returns the curve of the episodes that were read.
    pub(crate) fn curve(&self) -> LearningCurve {
        let points = (self.episode_count() / MIN_EPISODES_PER_POINT).clamp(1, MAX_POINTS);
        let groups_per_point = self.groups.len().div_ceil(points).max(1);
        let mut parts: Vec<EpisodeGroup> = self.groups.chunks(groups_per_point).map(EpisodeGroup::sum).collect();
        let episodes_per_point = groups_per_point * self.group_size;
        // If the last point has few episodes, it is merged with the point before it, because the mean of few episodes
        // is unreliable.
        if let [.., before, last] = &mut parts[..]
            && last.episodes < episodes_per_point / 2
        {
            before.add(&last.clone());
            parts.pop();
        }
        let mut episodes = 0.0;
        let mut steps = 0.0;
        let mut curve = LearningCurve { episodes_per_point, speed: speeds(&parts), ..LearningCurve::default() };
        for part in parts {
            let count = part.episodes as f64;
            let mean = part.episode_return / count;
            curve.episodes.push(episodes + count / 2.0);
            curve.steps.push(steps + part.steps / 2.0);
            curve.episode_return.push(mean.is_finite().then_some(mean));
            curve.success.push(100.0 * part.successes / count);
            curve.length.push(part.steps / count);
            episodes += count;
            steps += part.steps;
        }
        curve
    }
}

/// Returns the speed of each part of the curve, in steps per second.
///
/// A training writes many episodes at once, and all of them get the time of writing. Therefore consecutive parts are
/// combined until they cover enough time. Each part gets the mean speed of the parts with which it was combined.
fn speeds(parts: &[EpisodeGroup]) -> Vec<Option<f64>> {
    let end = parts.last().map_or(0.0, |last| last.end);
    let mut speeds = Vec::new();
    let mut start = 0.0;
    let mut steps = 0.0;
    for (index, part) in parts.iter().enumerate() {
        steps += part.steps;
        let time = part.end - start;
        let next_is_same_block = parts.get(index + 1).is_some_and(|next| next.end - part.end < SAME_BLOCK_SHARE * time);
        if time >= MIN_SPEED_SECONDS.max(end / MAX_SPEEDS) && !next_is_same_block {
            speeds.resize(index + 1, Some(steps / time));
            start = part.end;
            steps = 0.0;
        }
    }
    // The remaining parts at the end get the last measured speed. If none was measured, they get the curve's mean
    // speed.
    let last = speeds.last().copied().unwrap_or_else(|| Some(steps / end).filter(|speed| speed.is_finite()));
    speeds.resize(parts.len(), last);
    speeds
}

impl EpisodeGroup {
    fn add(&mut self, next: &Self) {
        self.episodes += next.episodes;
        self.episode_return += next.episode_return;
        self.steps += next.steps;
        self.successes += next.successes;
        self.end = next.end;
    }

    fn sum(groups: &[Self]) -> Self {
        let mut sum = Self::default();
        groups.iter().for_each(|group| sum.add(group));
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: &str = "#{\"t_start\": 1}\nr,l,t,success,terminated\n";

    fn read(text: &str) -> (EpisodeLog, LearningCurve) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        std::fs::write(&path, text).unwrap();
        let mut episodes = EpisodeLog::new(&path);
        assert!(episodes.read_new());
        let curve = episodes.curve();
        (episodes, curve)
    }

    #[test]
    fn a_point_is_a_mean_over_at_least_ten_episodes() {
        let line = |i: usize| format!("{}.5,4,{},{},1\n", i / 10, (i + 1) * 2, i % 2);
        let (episodes, curve) = read(&(NAMES.to_owned() + &(0..30).map(line).collect::<String>()));
        assert_eq!((episodes.episode_count(), episodes.fault()), (30, None));
        let expected = LearningCurve {
            episodes: vec![5.0, 15.0, 25.0],
            steps: vec![20.0, 60.0, 100.0],
            episode_return: vec![Some(0.5), Some(1.5), Some(2.5)],
            success: vec![50.0; 3],
            length: vec![4.0; 3],
            speed: vec![Some(2.0); 3],
            episodes_per_point: 10,
        };
        assert_eq!(curve, expected);
    }

    #[test]
    fn few_episodes_at_the_end_join_the_last_point() {
        let line = |i: usize| format!("1,1,{i},{},1\n", u8::from(i >= 20));
        // Nine points of eleven episodes, and two more episodes.
        let (_, curve) = read(&(NAMES.to_owned() + &(0..101).map(line).collect::<String>()));
        assert_eq!(
            (curve.episodes_per_point, curve.episodes.len(), curve.episodes[7], curve.episodes[8]),
            (11, 9, 82.5, 94.5)
        );
        assert_eq!((curve.steps[8], curve.success[8]), (94.5, 100.0), "no episode is lost");
        // Three points of eleven episodes, and one of ten.
        let (_, curve) = read(&(NAMES.to_owned() + &(0..43).map(line).collect::<String>()));
        assert_eq!((curve.episodes_per_point, &curve.episodes[..]), (11, &[5.5, 16.5, 27.5, 38.0][..]));
    }

    #[test]
    fn episodes_have_the_speed_of_their_block() {
        // Sixty episodes of ten steps: thirty after three seconds, and thirty after six.
        let line = |i: usize| format!("1,10,{}.{i:03},0,1\n", 3 * (1 + i / 30));
        let (episodes, curve) = read(&(NAMES.to_owned() + &(0..60).map(line).collect::<String>()));
        assert!(curve.speed.iter().flatten().all(|speed| (90.0..101.0).contains(speed)), "{:?}", curve.speed);
        assert_eq!(curve.speed.len(), 6);
        let (length, speed) = episodes.recent().unwrap();
        assert!(length == 10.0 && (90.0..101.0).contains(&speed), "{speed}");
        let (_, curve) = read(&(NAMES.to_owned() + "1,10,0,0,1\n"));
        assert_eq!(curve.speed, [None], "no time has passed");
    }

    #[test]
    fn long_trainings_have_bounded_curves() {
        let line = |i: usize| format!("{i},{},{i},{},0\n", 1 + i % 3, usize::from(i >= 7500));
        let (episodes, curve) = read(&(NAMES.to_owned() + &(0..15_000).map(line).collect::<String>()));
        assert_eq!(episodes.episode_count(), 15_000);
        assert!((80..=MAX_POINTS).contains(&curve.success.len()), "{}", curve.success.len());
        assert!(episodes.groups.len() <= MAX_GROUPS);
        let first = curve.success[0];
        let last = curve.success[curve.success.len() - 1];
        assert_eq!((first, last), (0.0, 100.0));
        assert!(*curve.episodes.last().unwrap() < 15_000.0 && *curve.steps.last().unwrap() < 30_000.0);
        let mean = curve.episode_return.iter().flatten().sum::<f64>() / curve.success.len() as f64;
        assert!((mean - 7499.5).abs() < 150.0, "{mean}"); // the last point has fewer episodes
    }

    #[test]
    fn faulty_lines_are_reported_and_skipped() {
        let (episodes, curve) = read(&(NAMES.to_owned() + "1,2,3,1,0\nx,2,4,1,0\n\n5,2,5,1,0\n6,2"));
        assert_eq!((episodes.episode_count(), episodes.fault()), (2, Some("line 4: `x` is not a number")));
        assert_eq!(curve.episode_return, [Some(3.0)]);
        let long = read(&(NAMES.to_owned() + &"x".repeat(100_000) + ",2,3,1,0\n")).0;
        assert!(long.fault().unwrap().len() < 400, "the quotation is shortened");
        assert_eq!(read("a,b\n1,2\n").0.fault(), Some("line 1: there is no column `r`"));
        assert_eq!(read(&(NAMES.to_owned() + "NaN,2,3,1,0\n")).1.episode_return, [None]);
    }
}
