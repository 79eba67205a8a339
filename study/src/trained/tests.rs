use std::path::PathBuf;

use super::*;

/// The checkpoints of a shipped experiment, which the learner wrote.
fn shipped() -> impl Iterator<Item = PathBuf> {
    let cells = Path::new(env!("CARGO_MANIFEST_DIR")).join("../results/beyond/confirm-2/cells");
    files::list(&cells).unwrap().into_iter().map(|cell| cell.join("training"))
}

/// The file of the weights has the checksum of what it was written from.
#[test]
fn what_the_learner_wrote_is_read_and_named_as_it_names_it() {
    let mut environments = std::collections::BTreeSet::new();
    for path in shipped() {
        let policy = TrainedPolicy::load(&path).unwrap();
        let names = files::list(&path.join("checkpoint")).unwrap();
        let names: Vec<String> =
            names.iter().map(|name| name.file_name().unwrap().to_string_lossy().into_owned()).collect();
        let weights = format!("weights-{}.safetensors", policy.id().unwrap());
        assert!(names.contains(&weights), "{weights} is none of {names:?}");
        policy.player(3, 1, 0).unwrap();
        environments.insert(policy.state.config.common.environment);
    }
    assert!(environments.len() > 2, "{environments:?}");
}

#[test]
fn damage_is_named() {
    let empty = tempfile::tempdir().unwrap();
    assert!(TrainedPolicy::load(empty.path()).unwrap_err().to_string().contains("holds no checkpoint"));

    let from = shipped().next().unwrap().join("checkpoint");
    let spoil = |name: &str, change: &dyn Fn(String, Vec<u8>) -> Vec<u8>| {
        let copy = tempfile::tempdir().unwrap();
        for path in files::list(&from).unwrap() {
            let file = path.file_name().unwrap().to_string_lossy().into_owned();
            let content = files::read(&path).unwrap();
            let spoiled = file.starts_with(name);
            let text = String::from_utf8_lossy(&content).into_owned();
            std::fs::write(copy.path().join(&file), if spoiled { change(text, content) } else { content }).unwrap();
        }
        TrainedPolicy::load(copy.path()).unwrap_err().to_string()
    };
    let replaced = |from: &'static str, to: &'static str| {
        move |text: String, _| {
            assert!(text.contains(from), "{from}");
            text.replacen(from, to, 1).into_bytes()
        }
    };
    assert!(spoil("weights", &|_, bytes| bytes[..bytes.len() / 2].to_vec()).contains("expected"));
    let flip = |_, mut bytes: Vec<u8>| {
        *bytes.last_mut().unwrap() ^= 1;
        bytes
    };
    assert!(spoil("weights", &flip).contains("another checksum"));
    assert!(spoil("checkpoint", &|_, bytes| bytes[..bytes.len() / 2].to_vec()).contains("not understood"));
    let later = replaced("\"format_version\": 2", "\"format_version\": 9");
    assert!(spoil("checkpoint", &later).contains("it has format 9, this program reads 1 to 2"));
    // Another architecture has other weights, whatever their checksum.
    let other = replaced("\"architecture\": \"ff\"", "\"architecture\": \"rc\"");
    assert!(spoil("checkpoint", &other).contains("arrays, expected"));
    let statistics = replaced("\"observation_normaliser\": {", "\"observation_normaliser\": null, \"left\": {");
    assert!(spoil("checkpoint", &statistics).contains("observation_normaliser: there is none"));
}

#[test]
fn a_changed_environment_is_told_from_the_one_that_was_trained_in() {
    let trained = TrainedPolicy::load(&shipped().next().unwrap()).unwrap().state.environment_spec;
    assert_eq!(trained.difference(&trained), None);
    let served = EnvironmentSeen { step_limit: trained.step_limit + 1, ..trained.clone() };
    assert_eq!(trained.difference(&served).unwrap().0, "step limit");
    let served = EnvironmentSeen { revision: 77, ..served };
    assert_eq!(trained.difference(&served).unwrap().0, "revision");
}
