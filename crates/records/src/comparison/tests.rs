use perturb_protocol::Version;
use rstest::rstest;

use super::*;
use crate::fixture::{assessed, episode};
use crate::records::Records;
use crate::results_table::{SELECTION_TEST, TableRow};

/// Returns records of a policy's tests on D and R. Each test has an episode for each element of `returns`. A return of
/// at least 5 is a success.
fn policy(returns: &[u32]) -> Records {
    let mut records = assessed("agent", "CartPole", &[Some(Version::D)], [1, 1, 1]).policies()[0].records.clone();
    let on = |set: &'static str| {
        returns.iter().zip(0..).map(move |(&steps, index)| episode(set, index, 1.0, steps, steps >= 5))
    };
    records.episodes = on("D").chain(on("R")).collect();
    records
}

fn condition<'a>(name: &str, policies: &'a [Records]) -> ComparedCondition<'a> {
    let keyed = policies.iter().enumerate().map(|(index, records)| (index.to_string(), records));
    ComparedCondition { name: name.into(), policies: keyed.collect() }
}

fn compared(x: &[Records], y: &[Records], score: ComparedScore) -> ConditionComparison {
    compare(&[condition("y", y), condition("x", x)], &["D".into()], score, None).unwrap()
}

/// Expected values are computed by hand: the differences by seed are 3, 4 and 8. Their mean is 5, and its standard
/// error √(14 / 2 / 3) = 1.5275.
#[test]
fn policies_with_the_same_key_are_pairs() {
    let [x, y] = [[4, 8, 9], [1, 4, 1]].map(|seeds| seeds.map(|score| policy(&[score, score + 1, score + 2])));
    let it = &compared(&x, &y, ComparedScore::Return).differences[0];
    assert_eq!((it.x.as_str(), it.y.as_str(), it.paired, it.seeds), ("x", "y", true, [3, 3]));
    assert_eq!((it.difference, &it.by_seed[..]), (5.0, &[3.0, 4.0, 8.0][..]));
    let [low, high] = it.seeds_95.unwrap();
    let half = 4.302_653 * 1.527_525; // the t quantile for 2 degrees of freedom
    assert!((low - (5.0 - half)).abs() < 1e-4 && (high - (5.0 + half)).abs() < 1e-4, "{low} {high}");
    assert_eq!(it.episodes_95, Some([5.0, 5.0]), "each episode has the same difference");
    assert_eq!((it.improvement, it.p, it.p.map(|p| p < 0.1)), (8.5 / 9.0, it.p_holm, Some(true)));
}

#[test]
fn unequal_numbers_of_seeds_are_compared_without_pairs() {
    let x = [1, 2, 4, 7].map(|score| policy(&[score; 4]));
    let y = [1, 2, 0].map(|score| policy(&[score; 4]));
    let it = &compared(&x, &y, ComparedScore::Return).differences[0];
    assert_eq!((it.paired, it.seeds, it.by_seed.len()), (false, [4, 3], 0));
    assert_eq!(it.difference, 2.5);
    // The degrees of freedom are Welch's 4.03.
    let [low, high] = it.seeds_95.unwrap();
    assert!((low + high - 5.0).abs() < 1e-9 && low < 0.0, "{low} {high}");
    // The data of `p_values_are_those_of_the_textbook_tests`, shifted by 1.
    let x = [2, 3, 5, 8].map(|score| policy(&[score; 4]));
    let p = compared(&x, &y, ComparedScore::Return).differences[0].p.unwrap();
    assert!((p - 0.071_872).abs() < 1e-5, "{p}");
}

#[rstest]
#[case(&[9], &[1], "x − y on D: +8.0 [+8.0, +8.0] over episodes: one seed each supports no conclusion about other \
    seeds")]
#[case(&[9, 5], &[1, 6], "x − y on D: +3.5, but +8.0 and -1.0 by seed: two seeds decide nothing")]
#[case(&[9, 9], &[2, 1], "x − y on D: +7.5, +7.0 and +8.0 by seed: two seeds decide nothing")]
#[case(&[9, 5, 5], &[1], "x − y on D: +5.3 [+5.3, +5.3] over episodes: 3 and 1 seeds decide nothing, \
    since each condition needs at least 3")]
#[case(&[9, 5, 5], &[1, 2, 3], "x − y on D: +4.3 [-3.7, +12.3] over 3 pairs of seeds, p = 0.145: undecided")]
#[case(&[9, 8, 8], &[1, 1, 1], "x has a higher mean return than y on D: +7.3 [+5.9, +8.8] over 3 pairs of seeds, p = 0.002")]
fn the_verdict_says_what_the_seeds_say(#[case] x: &[u32], #[case] y: &[u32], #[case] expected: &str) {
    let [x, y] = [x, y].map(|seeds| seeds.iter().map(|&score| policy(&[score; 3])).collect::<Vec<_>>());
    assert_eq!(compared(&x, &y, ComparedScore::Return).verdict, expected);
}

#[test]
fn holm_corrects_for_all_that_is_compared() {
    let seeds = [[9, 8, 8], [1, 1, 1], [1, 2, 1]].map(|seeds| seeds.map(|score| policy(&[score; 3])));
    let conditions = [condition("a", &seeds[0]), condition("b", &seeds[1]), condition("c", &seeds[2])];
    let sets = ["D".to_owned(), "R".to_owned()];
    let all = compare(&conditions, &sets, ComparedScore::Return, None).unwrap();
    let pairs: Vec<String> = all.differences.iter().map(|it| format!("{}-{}", it.x, it.y)).collect();
    assert_eq!(pairs, ["b-a", "c-a", "c-b", "b-a", "c-a", "c-b"]);
    let p: Vec<f64> = all.differences.iter().map(|it| it.p.unwrap()).collect();
    let corrected: Vec<f64> = all.differences.iter().map(|it| it.p_holm.unwrap()).collect();
    assert_eq!(corrected, holm(&p));
    assert!(all.verdict.starts_with("4 of 6 comparisons are decided after Holm's correction: b − a on D is "));
    let against = compare(&conditions, &sets, ComparedScore::Return, Some("b")).unwrap();
    let pairs: Vec<String> = against.differences.iter().map(|it| format!("{}-{}", it.x, it.y)).collect();
    assert_eq!(pairs, ["a-b", "c-b", "a-b", "c-b"]);
}

#[test]
fn success_rates_have_wilsons_interval_over_episodes() {
    let one = [policy(&[9, 9, 9, 1])];
    let it = compared(&one, &one, ComparedScore::Success);
    let (low, high) = crate::statistics::wilson(3, 4);
    assert_eq!((it.means[0].mean, it.means[0].seeds_95, it.means[0].episodes), (75.0, None, 4));
    let got = it.means[0].episodes_95.unwrap();
    assert!((got[0] - 100.0 * low).abs() < 1e-9 && (got[1] - 100.0 * high).abs() < 1e-9, "{got:?}");
    // Four equal policies give no more information about other episodes than one policy.
    let four = [one[0].clone(), one[0].clone(), one[0].clone(), one[0].clone()];
    let equal = compared(&four, &four, ComparedScore::Success);
    let of_four = equal.means[0].episodes_95.unwrap();
    assert!((of_four[0] - got[0]).abs() < 1e-9, "{of_four:?}");
    assert_eq!((equal.differences[0].p, equal.differences[0].improvement), (Some(1.0), 0.5));
    // Even if all episodes succeed, the interval is as wide as the small number of episodes requires.
    let all = [policy(&[9; 4])];
    let [low, high] = compared(&all, &all, ComparedScore::Success).means[0].episodes_95.unwrap();
    assert!(low < 60.0 && high == 100.0, "{low}");
    // An interval over seeds is clamped to the range of success rates, 0 to 100 %.
    let seeds = [policy(&[9; 4]), policy(&[1; 4]), policy(&[9; 4])];
    let over_seeds = compared(&seeds, &seeds, ComparedScore::Success).means[0].seeds_95;
    assert_eq!(over_seeds, Some([0.0, 100.0]));
}

#[test]
fn policies_with_different_episodes_are_not_compared_by_episode() {
    let x = [policy(&[1, 2, 3, 4])];
    let mut other = policy(&[1, 2, 3, 4]);
    other.episodes.iter_mut().for_each(|episode| episode.seed = 8);
    let y = [other];
    let it = &compared(&x, &y, ComparedScore::Return).differences[0];
    let half = 1.959_964 * (2.0 * 1.25_f64 / 4.0).sqrt();
    let [low, high] = it.episodes_95.unwrap();
    assert!(!it.same_episodes && (low + half).abs() < 1e-5 && (high - half).abs() < 1e-5, "{low} {high}");
    let same = &compared(&x, &x, ComparedScore::Return).differences[0];
    assert_eq!((same.same_episodes, same.episodes_95), (true, Some([0.0, 0.0])));
}

/// A row of a study's cell, by its algorithm and seed.
fn table_row(algorithm: &str, seed: u64, tested_on: &str, successes: u64) -> TableRow {
    TableRow {
        study: "study".into(),
        cell: format!("{algorithm}-{seed}"),
        environment: "CartPole".into(),
        revision: Some(1),
        algorithm: algorithm.into(),
        trained_on: "R".into(),
        tested_on: Some(tested_on.into()),
        seed,
        after_episodes: Some(100),
        episodes: Some(100),
        successes: Some(successes),
        mean_return: Some(successes as f64 / 3.0),
        mean_length: Some(1.0),
        settings: format!("{{\"algorithm\":\"{algorithm}\",\"seed\":{seed}}}"),
        ..TableRow::default()
    }
}

fn rows<'a>(name: &str, rows: &'a [TableRow]) -> TableCondition<'a> {
    TableCondition { name: name.into(), rows: rows.iter().collect() }
}

#[test]
fn rows_of_a_table_give_the_same_numbers_as_episodes() {
    // Recorded episodes with the same numbers of successes as the rows. Each policy plays different episodes.
    let counts = [[30, 60, 90], [20, 40, 90]];
    let policy = |seed: u64, successes: u64| {
        let steps: Vec<u32> = (0..100).map(|episode| if episode < successes { 9 } else { 1 }).collect();
        let mut records = policy(&steps);
        records.episodes.iter_mut().for_each(|episode| episode.seed = seed);
        records
    };
    let [x, y] = counts.map(|counts| [0, 1, 2].map(|seed| policy(10 * counts[1] + seed, counts[seed as usize])));
    let expected = compared(&x, &y, ComparedScore::Success);
    let table = |name, counts: [u64; 3]| {
        let row = |seed| table_row(name, seed, "D", counts[seed as usize]);
        let intermediate = TableRow { successes: Some(1), after_episodes: Some(10), ..row(0) };
        let failed = TableRow { tested_on: None, episodes: None, ..table_row(name, 7, "D", 0) };
        vec![row(0), intermediate, row(1), row(2), failed, table_row(name, 0, SELECTION_TEST, 5)]
    };
    let (of_x, of_y) = (table("x", counts[0]), table("y", counts[1]));
    let conditions = [rows("y", &of_y), rows("x", &of_x)];
    let got = compare_rows(&conditions, None, ComparedScore::Success, None).unwrap();
    assert!(got.from_counts && !expected.from_counts);
    assert_eq!(ConditionComparison { from_counts: false, ..got }, expected);
    let by_return = compare_rows(&conditions, None, ComparedScore::Return, None).unwrap();
    assert_eq!((by_return.means[1].mean, by_return.means[1].episodes_95), (20.0, None));
    assert_eq!((by_return.differences[0].episodes_95, by_return.differences[0].seeds_95.is_some()), (None, true));
}

#[test]
fn rows_that_are_no_conditions_are_refused() {
    let error = |conditions: &[TableCondition<'_>], sets: Option<&[String]>| {
        compare_rows(conditions, sets, ComparedScore::Success, None).unwrap_err().to_string()
    };
    let both = [table_row("a2c", 1, "D", 1), table_row("ppo", 1, "D", 1)];
    let text = error(&[rows("all", &both)], None);
    assert!(text.contains("several policies of seed 1, which differ by algorithm"), "{text}");
    let twice = [both[0].clone(), both[0].clone()];
    let text = error(&[rows("two tables", &twice)], None);
    assert!(text.contains("several policies of seed 1, which differ by study"), "{text}");
    let other = [TableRow { environment: "Acrobot".into(), ..both[1].clone() }];
    let text = error(&[rows("a", &both[..1]), rows("b", &other)], None);
    assert!(text.contains("in Acrobot (revision 1), CartPole (revision 1), but must be one environment"), "{text}");
    let text = error(&[rows("a", &both[..1])], Some(&["E".to_owned()]));
    assert!(text.contains("sets that all policies were tested on: D"), "{text}");
    let own = [table_row("a2c", 1, "long", 1)];
    let elsewhere = [TableRow { study: "other".into(), ..own[0].clone() }];
    assert!(compare_rows(&[rows("a", &own)], None, ComparedScore::Success, None).is_ok());
    let text = error(&[rows("a", &own), rows("b", &elsewhere)], None);
    assert!(text.contains("without tests"), "studies may call different sets by the same name: {text}");
    assert!(error(&[rows("a", &[])], None).contains("without policies"));
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let one = [policy(&[1, 2, 3])];
    let mut others = [policy(&[1, 2, 3])];
    let error = |conditions: &[ComparedCondition<'_>], set: &str, baseline: Option<&str>| {
        compare(conditions, &[set.to_owned()], ComparedScore::Return, baseline).unwrap_err().to_string()
    };
    let two = || [condition("a", &one), condition("b", &one)];
    assert!(error(&two(), "X", None).contains("the list of tests of a is D, R, E, but must be one with X"));
    assert!(error(&two(), "D", Some("c")).contains("one of a, b"));
    assert!(error(&[condition("a", &one), condition("a", &one)], "D", None).contains("`a` twice"));
    assert!(error(&[condition("a", &[])], "D", None).contains("without policies"));
    others[0].about.environment = "Acrobot".into();
    assert!(error(&[condition("a", &one), condition("b", &others)], "D", None).contains("like the others'"));
}
