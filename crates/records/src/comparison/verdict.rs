//! Describes comparisons in sentences that claim no more than the numbers show.

use super::{ComparedScore, ConditionDifference};
use crate::statistics::MIN_RUNS_FOR_INTERVAL;

/// A difference is called decided (statistically significant) if its corrected p-value is below this limit.
const MAX_DECIDED_P: f64 = 0.05;

impl ConditionDifference {
    /// Returns whether the difference is statistically significant: whether its p-value over seeds, with Holm's
    /// correction for all compared pairs, is below 0.05.
    pub fn is_decided(&self) -> bool {
        self.p_holm.is_some_and(|p| p < MAX_DECIDED_P)
    }
}

/// Describes one difference in words. `compared` is the number of differences in the whole comparison that have a
/// p-value.
pub(super) fn of_difference(it: &ConditionDifference, score: ComparedScore, compared: usize) -> String {
    let (Some(interval), Some(p), Some(corrected)) = (it.seeds_95, it.p, it.p_holm) else {
        return format!("{}: {}", few_seeds_numbers(it, score), few_seeds(it));
    };
    let numbers = format!(
        "{} {} over {}, p {}{}",
        points(it.difference, score),
        ends(interval),
        seeds(it),
        format_p(corrected),
        if compared > 1 { format!(" after Holm for {compared} comparisons") } else { String::new() },
    );
    if it.is_decided() {
        let (word, than) = (if it.difference > 0.0 { "higher" } else { "lower" }, scored(score));
        return format!("{} has a {word} {than} than {} on {}: {numbers}", it.x, it.y, it.tested_on);
    }
    let why = if p < MAX_DECIDED_P {
        format!("undecided after the correction (alone p {})", format_p(p))
    } else {
        "undecided".into()
    };
    format!("{} − {} on {}: {numbers}: {why}", it.x, it.y, it.tested_on)
}

/// Describes the whole comparison in one sentence. `compared` is the number of differences that have a p-value.
pub(super) fn of_all(all: &[ConditionDifference], score: ComparedScore, compared: usize) -> String {
    let Some(largest) = all.iter().reduce(|a, b| if b.difference.abs() > a.difference.abs() { b } else { a }) else {
        return "There is only one condition, so nothing is compared".into();
    };
    let decided: Vec<&ConditionDifference> = all.iter().filter(|it| it.is_decided()).collect();
    match (&decided[..], all) {
        (_, [one]) => one.verdict.clone(),
        ([], _) if compared == 0 => format!(
            "None of {} comparisons is decided; the largest difference is {}: {}",
            all.len(),
            few_seeds_numbers(largest, score),
            few_seeds(largest)
        ),
        ([], _) => {
            format!("None of {} comparisons is decided; the largest difference is {}", all.len(), largest.verdict)
        }
        (some, _) => {
            let describe = |it: &&ConditionDifference| {
                format!("{} − {} on {} is {}", it.x, it.y, it.tested_on, points(it.difference, score))
            };
            let verb = if some.len() == 1 { "is" } else { "are" };
            let listed = some.iter().map(describe).collect::<Vec<_>>().join(", ");
            format!("{} of {} comparisons {verb} decided after Holm's correction: {listed}", some.len(), all.len())
        }
    }
}

/// Describes a difference with too few seeds for an interval over seeds. Lists the difference of each pair of policies.
/// With fewer than two pairs, gives the interval over episodes instead.
fn few_seeds_numbers(it: &ConditionDifference, score: ComparedScore) -> String {
    let head = format!("{} − {} on {}: {}", it.x, it.y, it.tested_on, points(it.difference, score));
    let over_episodes = it.episodes_95.map(|interval| format!(" {} over episodes", ends(interval)));
    match &it.by_seed[..] {
        [] | [_] => format!("{head}{}", over_episodes.unwrap_or_default()),
        several => {
            let by_seed: Vec<String> = several.iter().map(|difference| signed(*difference)).collect();
            let apart = several.iter().any(|one| (one - it.difference).abs() > it.difference.abs() / 2.0);
            format!("{head}, {}{} by seed", if apart { "but " } else { "" }, by_seed.join(" and "))
        }
    }
}

fn few_seeds(it: &ConditionDifference) -> String {
    match it.seeds {
        [1, 1] => "one seed each supports no conclusion about other seeds".into(),
        [2, 2] => "two seeds decide nothing".into(),
        [x, y] => {
            format!("{x} and {y} seeds decide nothing, since each condition needs at least {MIN_RUNS_FOR_INTERVAL}")
        }
    }
}

fn seeds(it: &ConditionDifference) -> String {
    match it.seeds {
        [x, _] if it.paired => format!("{x} pairs of seeds"),
        [x, y] => format!("{x} and {y} seeds"),
    }
}

fn scored(score: ComparedScore) -> &'static str {
    match score {
        ComparedScore::Success => "success rate",
        ComparedScore::Return => "mean return",
        ComparedScore::Length => "mean length",
    }
}

fn points(difference: f64, score: ComparedScore) -> String {
    let unit = match score {
        ComparedScore::Success => " points",
        ComparedScore::Return => "",
        ComparedScore::Length => " steps",
    };
    format!("{}{unit}", signed(difference))
}

/// Formats a number with its sign and one decimal. Adding 0 turns -0.0 into 0.0.
fn signed(number: f64) -> String {
    format!("{:+.1}", (10.0 * number).round() / 10.0 + 0.0)
}

fn ends([low, high]: [f64; 2]) -> String {
    format!("[{}, {}]", signed(low), signed(high))
}

fn format_p(p: f64) -> String {
    if p < 0.0005 { "< 0.001".into() } else { format!("= {p:.3}") }
}
