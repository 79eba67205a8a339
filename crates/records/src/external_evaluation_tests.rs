use std::fs;

use perturb_protocol::Version::{D, E, R, RE};
use rstest::rstest;

use super::*;
use crate::fixture;

#[test]
fn what_is_written_is_read_and_replaced_only_on_request() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("mine");
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R), None], [200, 190, 100]);
    assessed.write(&path, false).unwrap();
    assert_eq!(ExternalEvaluation::read(&path).unwrap(), assessed);
    let refused = assessed.write(&path, false).unwrap_err().to_string();
    assert!(refused.contains("overwrite=True replaces it"), "{refused}");
    fs::write(path.join("episodes-mine.parquet"), "not the assessment's").unwrap();
    fixture::assessed("PPO", "CartPole", &[Some(R), Some(RE)], [200; 3]).write(&path, true).unwrap();
    let there = ["assessment.json", "episodes-R-or-E.parquet", "episodes-R.parquet", "episodes-mine.parquet"];
    assert_eq!(files::list(&path).unwrap(), there.map(|file| path.join(file)), "only the former's records are gone");
    fs::remove_file(path.join(ASSESSMENT)).unwrap();
    let refused = assessed.write(&path, true).unwrap_err().to_string();
    assert!(refused.contains("name another folder"), "{refused}");
    let refused = ExternalEvaluation::read(&path).unwrap_err().to_string();
    assert!(refused.contains("holds no assessment"), "{refused}");
}

#[test]
fn an_assessment_is_there_until_another_one_is_written() {
    let directory = tempfile::tempdir().unwrap();
    let former = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R)], [200; 3]);
    former.write(directory.path(), false).unwrap();
    fs::create_dir(directory.path().join("episodes-E.parquet")).unwrap(); // a folder, so that this file cannot be written
    fixture::assessed("PPO", "CartPole", &[Some(E)], [100; 3]).write(directory.path(), true).unwrap_err();
    assert_eq!(ExternalEvaluation::read(directory.path()).unwrap().policies(), former.policies());
}

#[test]
fn what_is_damaged_can_be_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    fs::write(directory.path().join(ASSESSMENT), "{").unwrap();
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]);
    assessed.write(directory.path(), true).unwrap();
    assert_eq!(ExternalEvaluation::read(directory.path()).unwrap().policies(), assessed.policies());
}

#[test]
fn what_was_changed_is_refused_and_can_be_overwritten() {
    let directory = tempfile::tempdir().unwrap();
    let assessed = fixture::assessed("PPO", "CartPole", &[Some(D), Some(R)], [200; 3]);
    assessed.write(directory.path(), false).unwrap();
    let json = directory.path().join(ASSESSMENT);
    let written = fs::read_to_string(&json).unwrap();
    fs::write(&json, written.replace("\"PPO\"", "\"A2C\"")).unwrap();
    let refused = ExternalEvaluation::read(directory.path()).unwrap_err().to_string();
    assert!(refused.contains("the checksum does not match"), "{refused}");
    let less = fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]);
    less.write(directory.path(), true).unwrap();
    assert_eq!(files::list(directory.path()).unwrap().len(), 2, "the former's records are gone");
}

#[rstest]
#[case("{", "is damaged")]
#[case(r#"{"format_version": 2, "policies": 1}"#, "has format 2; this program reads 1")]
#[case(r#"{"format_version": 1, "environment": "CartPole", "agent": "PPO", "policies": []}"#, "there is none")]
#[case(
    r#"{"format_version": 1, "environment": "CartPole", "agent": "PPO", "policies": [{"file": "episodes-D.parquet"}]}"#,
    "missing field"
)]
fn what_is_no_assessment_is_refused(#[case] document: &str, #[case] words: &str) {
    let directory = tempfile::tempdir().unwrap();
    fixture::assessed("PPO", "CartPole", &[Some(D)], [200; 3]).write(directory.path(), false).unwrap();
    fs::write(directory.path().join(ASSESSMENT), document).unwrap();
    let refused = ExternalEvaluation::read(directory.path()).unwrap_err().to_string();
    assert!(refused.contains(words), "{refused}");
}

#[test]
fn policies_of_an_agent_differ_in_training_distribution() {
    let one = |name: &str, trained_on| fixture::assessed("PPO", name, &[trained_on], [200; 3]).policies;
    for (policies, words) in [
        ([one("CartPole", Some(D)), one("Pendulum", Some(R))].concat(), "they are of CartPole and Pendulum"),
        ([one("CartPole", None), one("CartPole", None)].concat(), "two have the same training distribution"),
    ] {
        let refused = ExternalEvaluation::new(String::new(), "PPO".into(), policies).unwrap_err().to_string();
        assert!(refused.contains(words), "{refused}");
    }
}
