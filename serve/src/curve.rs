//! A learning curve from `monitor.csv` as it grows: some hundred points, however many episodes there are.

use perturb_study::words::shortened;
use serde::Serialize;

use crate::tail::{Look, MOST, Tail};

/// When there are so many stretches, pairs of them become one.
const MOST_STRETCHES: usize = 512;
/// A curve has at most so many points …
const MOST_POINTS: usize = 160;
/// … and one for so many episodes at least.
const LEAST_EPISODES: usize = 10;
/// A speed is one of so many seconds at least …
const LEAST_SECONDS: f64 = 1.0;
/// … and there are at most so many.
const MOST_SPEEDS: f64 = 40.0;
/// Episodes that come after less than this share of the time before them were written with them.
const AT_ONCE: f64 = 0.02;

/// Follows the episodes of a training.
#[derive(Debug)]
pub(crate) struct Episodes {
    tail: Tail,
    /// Where the columns return, length, seconds and success are; `None` before the names were read.
    columns: Option<[usize; 4]>,
    stretches: Vec<Stretch>,
    /// Episodes in a stretch, but for the last one.
    size: usize,
    /// Lines, and what is wrong with the first that is not understood.
    lines: usize,
    wrong: Option<String>,
    /// Why it cannot be read now.
    unread: Option<String>,
}

/// Sums over some episodes in a row.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Stretch {
    episodes: usize,
    episode_return: f64,
    steps: f64,
    successes: f64,
    /// Seconds since the start of the training at its end.
    end: f64,
}

/// A curve as it is drawn. All lists have one number a point: the mean over some episodes.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Curve {
    /// Episodes in the middle of the point.
    pub(crate) episodes: Vec<f64>,
    /// Steps of all environments in the middle of it.
    pub(crate) steps: Vec<f64>,
    /// The undiscounted return.
    #[serde(rename = "return")]
    pub(crate) episode_return: Vec<Option<f64>>,
    /// The success rate, %.
    pub(crate) success: Vec<f64>,
    /// Steps of an episode.
    pub(crate) length: Vec<f64>,
    /// Steps in a second.
    pub(crate) speed: Vec<Option<f64>>,
    /// Episodes of a point, but for the last one.
    pub(crate) each: usize,
}

impl Episodes {
    /// Of the log at `path`, which need not be there yet.
    pub(crate) fn of(path: &std::path::Path) -> Self {
        let (columns, stretches) = (None, Vec::new());
        Self { tail: Tail::of(path), columns, stretches, size: 1, lines: 0, wrong: None, unread: None }
    }

    /// Reads what is new; whether anything is.
    pub(crate) fn look(&mut self) -> bool {
        let new = match self.tail.look() {
            Ok(Look::Same) => return self.unread.take().is_some(),
            Ok(Look::More(new)) => new,
            Ok(Look::Anew(new)) => {
                (self.columns, self.stretches, self.size, self.lines, self.wrong) = (None, Vec::new(), 1, 0, None);
                new
            }
            Ok(Look::Endless) => {
                let wrong =
                    format!("line {} is longer than {} MiB; nothing behind it is read", self.lines + 1, MOST >> 20);
                self.wrong = Some(wrong);
                return true;
            }
            Err(error) => {
                let unread = Some(format!("it cannot be read: {error}"));
                return std::mem::replace(&mut self.unread, unread.clone()) != unread;
            }
        };
        self.unread = None;
        for line in new.split(|&byte| byte == b'\n').filter(|line| !line.is_empty()) {
            self.lines += 1;
            if let Err(reason) = self.line(&String::from_utf8_lossy(line)) {
                self.wrong.get_or_insert(format!("line {}: {reason}", self.lines));
            }
        }
        true
    }

    /// How many episodes there were.
    pub(crate) fn count(&self) -> usize {
        self.stretches.iter().map(|stretch| stretch.episodes).sum()
    }

    /// Steps of an episode, and steps in a second, of the last tenth of the time; `None` before there are any.
    pub(crate) fn recent(&self) -> Option<(f64, f64)> {
        let all = self.stretches.last()?.end;
        let long_ago = |stretch: &Stretch| all - stretch.end >= LEAST_SECONDS.max(all / 10.0);
        let first = self.stretches.iter().rposition(long_ago).map_or(0, |before| before + 1);
        let recent = Stretch::sum(&self.stretches[first..]);
        let begun = first.checked_sub(1).map_or(0.0, |before| self.stretches[before].end);
        let (length, speed) = (recent.steps / recent.episodes as f64, recent.steps / (recent.end - begun));
        (length > 0.0 && speed > 0.0 && speed.is_finite()).then_some((length, speed))
    }

    /// What is wrong with the log.
    pub(crate) fn wrong(&self) -> Option<&str> {
        self.unread.as_deref().or(self.wrong.as_deref())
    }

    fn line(&mut self, line: &str) -> Result<(), String> {
        if line.starts_with('#') {
            return Ok(());
        }
        let fields: Vec<&str> = line.trim_end().split(',').collect();
        let Some(columns) = self.columns else {
            let place = |name: &str| {
                fields.iter().position(|field| *field == name).ok_or_else(|| format!("there is no column `{name}`"))
            };
            self.columns = Some([place("r")?, place("l")?, place("t")?, place("success")?]);
            return Ok(());
        };
        let number = |column: usize| {
            let text = fields.get(column).copied().unwrap_or_default();
            text.parse::<f64>().map_err(|_| format!("`{}` is no number", shortened(text)))
        };
        let [episode_return, steps, end, successes] = columns.map(number);
        self.add(Stretch {
            episodes: 1,
            episode_return: episode_return?,
            steps: steps?,
            successes: successes?,
            end: end?,
        });
        Ok(())
    }

    fn add(&mut self, episode: Stretch) {
        match self.stretches.last_mut() {
            Some(last) if last.episodes < self.size => last.add(&episode),
            _ => self.stretches.push(episode),
        }
        if self.stretches.len() > MOST_STRETCHES {
            self.stretches = self.stretches.chunks(2).map(Stretch::sum).collect();
            self.size *= 2;
        }
    }

    /// The curve so far.
    pub(crate) fn curve(&self) -> Curve {
        let points = (self.count() / LEAST_EPISODES).clamp(1, MOST_POINTS);
        let together = self.stretches.len().div_ceil(points).max(1);
        let mut parts: Vec<Stretch> = self.stretches.chunks(together).map(Stretch::sum).collect();
        let each = together * self.size;
        // A mean over a few episodes at the end would only mislead.
        if let [.., before, last] = &mut parts[..]
            && last.episodes < each / 2
        {
            before.add(&last.clone());
            parts.pop();
        }
        let (mut episodes, mut steps) = (0.0, 0.0);
        let mut curve = Curve { each, speed: speeds(&parts), ..Curve::default() };
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

/// Steps in a second of each part. Episodes are written in blocks, with the time of their writing: so parts share a speed
/// until enough time has passed.
fn speeds(parts: &[Stretch]) -> Vec<Option<f64>> {
    let all = parts.last().map_or(0.0, |last| last.end);
    let (mut speeds, mut begun, mut steps) = (Vec::new(), 0.0, 0.0);
    for (place, part) in parts.iter().enumerate() {
        steps += part.steps;
        let time = part.end - begun;
        let at_once = parts.get(place + 1).is_some_and(|next| next.end - part.end < AT_ONCE * time);
        if time >= LEAST_SECONDS.max(all / MOST_SPEEDS) && !at_once {
            speeds.resize(place + 1, Some(steps / time));
            (begun, steps) = (part.end, 0.0);
        }
    }
    // What is left at the end, and what was too short altogether.
    let rest = speeds.last().copied().unwrap_or_else(|| Some(steps / all).filter(|speed| speed.is_finite()));
    speeds.resize(parts.len(), rest);
    speeds
}

impl Stretch {
    fn add(&mut self, next: &Self) {
        self.episodes += next.episodes;
        self.episode_return += next.episode_return;
        self.steps += next.steps;
        self.successes += next.successes;
        self.end = next.end;
    }

    fn sum(stretches: &[Self]) -> Self {
        let mut sum = Self::default();
        stretches.iter().for_each(|stretch| sum.add(stretch));
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: &str = "#{\"t_start\": 1}\nr,l,t,success,terminated\n";

    fn read(text: &str) -> (Episodes, Curve) {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("monitor.csv");
        std::fs::write(&path, text).unwrap();
        let mut episodes = Episodes::of(&path);
        assert!(episodes.look());
        let curve = episodes.curve();
        (episodes, curve)
    }

    #[test]
    fn a_point_is_a_mean_over_ten_episodes_at_least() {
        let line = |i: usize| format!("{}.5,4,{},{},1\n", i / 10, (i + 1) * 2, i % 2);
        let (episodes, curve) = read(&(NAMES.to_owned() + &(0..30).map(line).collect::<String>()));
        assert_eq!((episodes.count(), episodes.wrong()), (30, None));
        let expected = Curve {
            episodes: vec![5.0, 15.0, 25.0],
            steps: vec![20.0, 60.0, 100.0],
            episode_return: vec![Some(0.5), Some(1.5), Some(2.5)],
            success: vec![50.0; 3],
            length: vec![4.0; 3],
            speed: vec![Some(2.0); 3],
            each: 10,
        };
        assert_eq!(curve, expected);
    }

    #[test]
    fn a_few_episodes_at_the_end_are_no_point_of_their_own() {
        let line = |i: usize| format!("1,1,{i},{},1\n", u8::from(i >= 20));
        // Nine of eleven, and two.
        let (_, curve) = read(&(NAMES.to_owned() + &(0..101).map(line).collect::<String>()));
        assert_eq!((curve.each, curve.episodes.len(), curve.episodes[7], curve.episodes[8]), (11, 9, 82.5, 94.5));
        assert_eq!((curve.steps[8], curve.success[8]), (94.5, 100.0), "nothing is lost");
        // Eleven, and then ten.
        let (_, curve) = read(&(NAMES.to_owned() + &(0..43).map(line).collect::<String>()));
        assert_eq!((curve.each, &curve.episodes[..]), (11, &[5.5, 16.5, 27.5, 38.0][..]));
    }

    #[test]
    fn episodes_that_are_written_in_blocks_have_the_speed_of_their_blocks() {
        // Sixty episodes of ten steps, thirty at a time: after three seconds, and after six.
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
    fn long_trainings_have_no_more_points_and_no_other_sums() {
        let line = |i: usize| format!("{i},{},{i},{},0\n", 1 + i % 3, usize::from(i >= 7500));
        let (episodes, curve) = read(&(NAMES.to_owned() + &(0..15_000).map(line).collect::<String>()));
        assert_eq!(episodes.count(), 15_000);
        assert!((80..=MOST_POINTS).contains(&curve.success.len()), "{}", curve.success.len());
        assert!(episodes.stretches.len() <= MOST_STRETCHES);
        let (first, last) = (curve.success[0], curve.success[curve.success.len() - 1]);
        assert_eq!((first, last), (0.0, 100.0));
        assert!(*curve.episodes.last().unwrap() < 15_000.0 && *curve.steps.last().unwrap() < 30_000.0);
        let mean = curve.episode_return.iter().flatten().sum::<f64>() / curve.success.len() as f64;
        assert!((mean - 7499.5).abs() < 150.0, "{mean}"); // the last point has fewer episodes than the others
    }

    #[test]
    fn what_is_not_understood_is_told_and_the_rest_is_shown() {
        let (episodes, curve) = read(&(NAMES.to_owned() + "1,2,3,1,0\nx,2,4,1,0\n\n5,2,5,1,0\n6,2"));
        assert_eq!((episodes.count(), episodes.wrong()), (2, Some("line 4: `x` is no number")));
        assert_eq!(curve.episode_return, [Some(3.0)]);
        let long = read(&(NAMES.to_owned() + &"x".repeat(100_000) + ",2,3,1,0\n")).0;
        assert!(long.wrong().unwrap().len() < 400, "no more is quoted than anybody reads");
        assert_eq!(read("a,b\n1,2\n").0.wrong(), Some("line 1: there is no column `r`"));
        assert_eq!(read(&(NAMES.to_owned() + "NaN,2,3,1,0\n")).1.episode_return, [None]);
    }
}
