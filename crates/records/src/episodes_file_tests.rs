use perturb_protocol::Version;

use super::*;
use crate::fixture::assessed;

/// The episodes of two policies, in environments with different parameters.
fn study() -> (StudyEpisodes, [Records; 2]) {
    let records = |environment: &str, steps| {
        let agent = assessed("a", environment, &[Some(Version::D)], [steps, 190, 5]);
        agent.policies()[0].records.clone()
    };
    let [one, mut two] = [records("CartPole", 200), records("Acrobot", 80)];
    two.about.parameters[0].name = "mass".into();
    two.episodes[3].achieved = None;
    two.episodes[4].ending = Ending::Diverged;
    let mut study = StudyEpisodes::default();
    study.insert("b", two.clone());
    study.insert("a", one.clone());
    (study, [one, two])
}

#[test]
fn episodes_read_back_without_applied_parameters() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("study.parquet");
    assert_eq!(StudyEpisodes::read_if_exists(&path).unwrap(), None);
    let (study, [one, two]) = study();
    study.write(&path).unwrap();
    let read = StudyEpisodes::read_if_exists(&path).unwrap().unwrap();
    assert_eq!(read, study);
    assert_eq!(read.policies(), 2);
    for (cell, records) in [("a", one), ("b", two)] {
        assert_eq!(read.of_cell(cell), Some(&without_applied(records.clone())));
        assert_eq!(read.of_cell(cell).unwrap().result("D", None), records.result("D", None));
    }
    assert!(matches!(Records::read(&path), Err(RecordsError::Damaged { .. })));
}

#[test]
fn the_first_differing_episode_is_named() {
    let (study, [mut replayed, _]) = study();
    assert_eq!(study.first_difference("a", "E", &replayed), None);
    assert_eq!(study.first_difference("c", "E", &replayed), None, "there is nothing to compare with");
    let second = replayed.episodes.iter_mut().filter(|episode| episode.set == "E").nth(1).unwrap();
    second.length = 7;
    // The success is not compared. An earlier episode with another success does not hide the difference.
    let first = replayed.episodes.iter_mut().find(|episode| episode.set == "E").unwrap();
    first.success = !first.success;
    let expected = "E, environment 1, episode 0: length was 6, is 7";
    assert_eq!(study.first_difference("a", "E", &replayed).as_deref(), Some(expected));
    assert_eq!(study.first_difference("a", "D", &replayed), None);
    replayed.episodes.truncate(3);
    assert!(study.first_difference("a", "D", &replayed).unwrap().contains("the record has more episodes"));
}

#[test]
fn a_checksum_changes_with_any_value_of_an_episode() {
    let (_, [records, _]) = study();
    let checksum = records.checksum("D").unwrap();
    assert_eq!(records.checksum("none"), None);
    assert_eq!(checksum.len(), 64);
    let changes: [fn(&mut EpisodeRecord); 11] = [
        |it| it.seed += 1,
        |it| it.environment_index += 1,
        |it| it.episode_index += 1,
        |it| it.requested[0] += 1.0,
        |it| it.applied[0] += 1.0,
        |it| it.model_hash.push('a'),
        |it| it.episode_return += 1.0,
        |it| it.length += 1,
        |it| it.success = !it.success,
        |it| it.ending = Ending::Diverged,
        |it| it.also_achieved = Some(0.0),
    ];
    for (index, change) in changes.into_iter().enumerate() {
        let mut other = records.clone();
        change(other.episodes.iter_mut().find(|episode| episode.set == "D").unwrap());
        assert_ne!(other.checksum("D"), Some(checksum.clone()), "change {index}");
        assert_eq!(other.checksum("E"), records.checksum("E"), "change {index}");
    }
}
