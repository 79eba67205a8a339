use perturb_protocol::Version;

use super::*;
use crate::success::Side;

fn records() -> Records {
    let success =
        Criterion { quantity: "steps".into(), unit: "1".into(), side: Side::AtMost, threshold: 80.0, most: None };
    let parameter =
        |name: &str, applied: &str| RecordedParameter { name: name.into(), unit: "kg".into(), applied: applied.into() };
    let about = RecordsMetadata {
        environment: "Acrobot".into(),
        revision: 0,
        parameters: vec![parameter("mass", "mass"), parameter("length", "rod")],
        applied: vec!["rod".into(), "mass".into(), "total".into()],
        policy: "00000001-0a".into(),
        episodes_per_trial: 1,
        success: Some(success),
        text_success: None,
        code_success: None,
        also: None,
        tests: Vec::new(),
    };
    let mut records = Records::new(about);
    for version in [Version::D, Version::E] {
        let episodes = (0..5).map(|index| episode(version, index)).collect();
        records.add(RecordedTest { set: version.into(), seed: u64::MAX, axes: None }, episodes);
    }
    records
}

fn episode(version: Version, index: u64) -> EpisodeRecord {
    let steps = 70 + 10 * index as u32;
    EpisodeRecord {
        set: version.to_string(),
        seed: u64::MAX,
        environment_index: u32::MAX,
        episode_index: index,
        requested: vec![0.1, 2.0 / 3.0],
        applied: vec![2.0 / 3.0, 0.1, 1.1],
        model_hash: String::new(),
        episode_return: -1.0 / 3.0,
        length: steps,
        success: steps <= 80,
        ending: [Ending::Terminated, Ending::Truncated, Ending::Diverged][index as usize % 3],
        achieved: (index < 4).then_some(f64::from(steps)),
        also_achieved: None,
    }
}

#[test]
fn records_read_back_bit_for_bit_and_always_have_the_same_bytes() {
    let directory = tempfile::tempdir().unwrap();
    let [one, other] = ["one", "other"].map(|name| directory.path().join(name));
    records().write(&one).unwrap();
    records().write(&other).unwrap();
    assert_eq!(std::fs::read(&one).unwrap(), std::fs::read(&other).unwrap());
    assert_eq!(Records::read(&one).unwrap(), records());
}

/// Returns records of an environment whose two criteria compare different quantities: steps at the end of an episode,
/// and the longest series of successive steps.
fn of_two_rules() -> Records {
    let rule = |quantity: &str| proto::Success {
        quantity: quantity.into(),
        unit: "1".into(),
        comparison: proto::Comparison::AtLeast.into(),
        threshold: 100.0,
        ..Default::default()
    };
    let environment = proto::Environment {
        step_limit: 200,
        success: Some(rule("steps")),
        code_success: Some(rule("steps_in_a_row")),
        ..Default::default()
    };
    Records::new(RecordsMetadata::new(&environment, String::new(), 1))
}

#[test]
fn episodes_can_be_judged_by_either_rule() {
    for by_code in [false, true] {
        let mut records = of_two_rules();
        if by_code {
            records.about.judge_by(&Rule::Code).unwrap();
        }
        assert_eq!(records.about.is_judged_by_code(), by_code);
        let at = |index: u64, at_the_end: f64, in_a_row: f64| {
            let (achieved, also) = if by_code { (in_a_row, at_the_end) } else { (at_the_end, in_a_row) };
            let (requested, applied) = (Vec::new(), Vec::new());
            let (achieved, also_achieved) = (Some(achieved), Some(also));
            EpisodeRecord { requested, applied, achieved, also_achieved, ..episode(Version::D, index) }
        };
        let episodes = vec![at(0, 150.0, 150.0), at(1, 20.0, 120.0), at(2, 0.0, 110.0), at(3, 0.0, 99.0)];
        records.add(RecordedTest { set: Version::D.into(), seed: 1, axes: None }, episodes);

        let directory = tempfile::tempdir().unwrap();
        records.write(&directory.path().join(FILE)).unwrap();
        let records = Records::read(&directory.path().join(FILE)).unwrap();
        let percent = |rule: &str| {
            let criterion = records.about.criterion(&rule.parse().unwrap()).unwrap();
            records.result("D", Some(&criterion)).success_percent
        };
        for (rule, expected) in [
            ("text", 25.0),
            ("code", 75.0),
            ("steps=20", 50.0),
            ("steps_in_a_row=99", 100.0),
            ("steps_in_a_row=121", 25.0),
        ] {
            assert_eq!(percent(rule), expected, "{rule}");
        }
    }
}

#[test]
fn a_file_of_something_else_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(FILE);
    assert!(matches!(Records::read(&path), Err(RecordsError::Missing { .. })));
    records().write(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for damaged in [&b"PAR1"[..], b"", &whole[..whole.len() / 2], &whole[1..]] {
        std::fs::write(&path, damaged).unwrap();
        let error = Records::read(&path).unwrap_err().to_string();
        assert!(error.contains("does not contain recorded episodes"), "{error}");
    }
    std::fs::write(&path, "environment = 'CartPole'").unwrap();
    let error = Records::read(&path).unwrap_err().to_string();
    assert!(error.contains("it is not a Parquet file"), "{error}");
}

#[test]
fn every_changed_bit_that_matters_is_refused() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join(FILE);
    records().write(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    let mut refused = 0;
    for place in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[place] ^= 1 << (place % 8);
        std::fs::write(&path, damaged).unwrap();
        match Records::read(&path) {
            Ok(read) => assert_eq!(read, records(), "byte {place}"),
            Err(error) => {
                assert!(error.to_string().contains("the checksum does not match"), "byte {place}: {error}");
                refused += 1;
            }
        }
    }
    assert_eq!(refused, whole.len() - "perturb.crc32c=".len(), "only what says that there is a checksum may change");
}

#[test]
fn figures_follow_from_episodes_at_any_threshold() {
    let records = records();
    let result = records.result("D", None);
    assert_eq!((result.episodes, result.success_percent, result.mean_length), (5, 40.0, 90.0));
    let criterion = |value| records.about.success.clone().map(|criterion| Criterion { threshold: value, ..criterion });
    for (threshold, percent) in [(69.0, 0.0), (80.0, 40.0), (90.0, 60.0), (1000.0, 80.0)] {
        assert_eq!(records.result("D", criterion(threshold).as_ref()).success_percent, percent, "{threshold}");
    }
}

#[test]
fn a_value_that_the_physics_did_not_take_is_named() {
    let mut records = records();
    let agreement = records.agreement();
    assert_eq!((agreement.episodes, agreement.largest.unwrap().relative), (10, 0.0));
    records.episodes[3].applied[1] = 0.1 * (1.0 + 1e-12);
    assert!(!records.agreement().largest.unwrap().exceeds_tolerance(), "rounding");
    records.episodes[3].applied[1] = 0.2;
    let largest = records.agreement().largest.unwrap();
    assert!(largest.exceeds_tolerance());
    assert_eq!(largest.to_string(), "the parameter mass was requested as 0.1, but the physics ran with 0.2");
    records.episodes[3].applied[1] = f64::NAN;
    assert!(records.agreement().largest.unwrap().exceeds_tolerance());
    records.episodes[3].applied[1] = 0.2;
    records.about.parameters[1].applied = String::new();
    let agreement = records.agreement();
    assert_eq!(agreement.episodes, 0, "the server did not name the applied quantity of every parameter");
    assert!(agreement.largest.unwrap().exceeds_tolerance(), "the other parameter is still compared");
    records.episodes[3].requested.clear();
    assert!(records.agreement().largest.unwrap().exceeds_tolerance(), "a receipt that lacks values");
}
