use super::*;
use crate::policy::Policy;

fn checkpoint(seed: u64, iterations: u64) -> Checkpoint {
    // Odd seeds feed-forward, even ones recurrent.
    let lstm = seed.is_multiple_of(2).then_some(3);
    let action = ActionKind::Continuous { size: 2 };
    let policy = PolicySpec { observation_size: 3, action, hidden: vec![4, 5], lstm };
    let mut normaliser = ObservationNormaliser::new(3);
    normaliser.update(&[0.1, 1e-7, -3.0, 0.3, 2e-7, 5.0]).unwrap();
    let config = TrainConfig::from_table("test", "environment = 'Toy'".parse().unwrap()).unwrap();
    let state = State {
        environment: "Toy".into(),
        environment_spec: EnvironmentSummary {
            revision: 1,
            step_limit: 10,
            observation: vec!["x".into(), "y".into(), "z".into()],
            action: policy.action,
            parameters: vec!["mass".into()],
            model_hash: String::new(),
        },
        algorithm: AlgorithmName::Ppo,
        architecture: if lstm.is_some() { Architecture::Rc } else { Architecture::Ff },
        policy: policy.clone(),
        train_version: Version::R,
        episodes_per_trial: 2,
        seed,
        observation_normaliser: Some(normaliser),
        reward_normaliser: Some(RewardNormaliser::new(2, 0.99)),
        counters: Counters { iterations, timesteps: 7, episodes: 3, generated_episodes: 4, learned_timesteps: 5 },
        config: config.table(),
    };
    Checkpoint { state, weights: Policy::new(policy, seed).unwrap().weights() }
}

fn names(directory: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn what_is_saved_is_loaded_bit_for_bit_from_the_run_or_its_folder() {
    let run = tempfile::tempdir().unwrap();
    for seed in [1, 2] {
        let saved = checkpoint(seed, seed);
        saved.save(&run.path().join("checkpoint")).unwrap();
        assert_eq!(Checkpoint::load(run.path()).unwrap(), saved);
        assert_eq!(Checkpoint::load(&run.path().join("checkpoint")).unwrap(), saved);
        assert_eq!(saved.config().unwrap().table(), saved.state.config);
    }
}

#[test]
fn only_the_current_weights_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    checkpoint(1, 1).save(directory.path()).unwrap();
    fs::write(directory.path().join(".tmp-checkpoint.json"), "left by a crash").unwrap();
    checkpoint(2, 2).save(directory.path()).unwrap();
    let names = names(directory.path());
    assert_eq!(names.len(), 2, "{names:?}");
    assert_eq!(names[0], "checkpoint.json");
    assert!(names[1].starts_with("weights-00000002-"));
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), checkpoint(2, 2));
}

/// Every state of the directory that a crash during a save can leave.
#[test]
fn a_crash_at_any_moment_leaves_a_whole_checkpoint() {
    let (old, new) = (checkpoint(1, 1), checkpoint(2, 2));
    let after = tempfile::tempdir().unwrap();
    new.save(after.path()).unwrap();
    let after_names = names(after.path());
    let new_weights = fs::read(after.path().join(&after_names[1])).unwrap();
    let new_json = fs::read(after.path().join(JSON)).unwrap();

    let load_with = |files: &[(&str, &[u8])]| {
        let directory = tempfile::tempdir().unwrap();
        old.save(directory.path()).unwrap();
        for (name, content) in files {
            fs::write(directory.path().join(name), content).unwrap();
        }
        let loaded = Checkpoint::load(directory.path()).unwrap();
        // A later save finds its way out of any of them.
        new.save(directory.path()).unwrap();
        assert_eq!(names(directory.path()), after_names);
        loaded
    };
    let temporary = format!(".tmp-{}", after_names[1]);
    assert_eq!(load_with(&[(&temporary, &new_weights[..10])]), old);
    assert_eq!(load_with(&[(&temporary, &new_weights)]), old);
    assert_eq!(load_with(&[(&after_names[1], &new_weights)]), old);
    assert_eq!(load_with(&[(&after_names[1], &new_weights), (".tmp-checkpoint.json", &new_json[..50])]), old);
    assert_eq!(load_with(&[(&after_names[1], &new_weights), (JSON, &new_json)]), new);
}

#[test]
fn damage_is_named() {
    let empty = tempfile::tempdir().unwrap();
    assert!(Checkpoint::load(empty.path()).unwrap_err().to_string().contains("holds no checkpoint"));

    let spoil = |name: &str, change: &dyn Fn(Vec<u8>) -> Vec<u8>| {
        let directory = tempfile::tempdir().unwrap();
        checkpoint(1, 1).save(directory.path()).unwrap();
        let path = names(directory.path()).into_iter().find(|known| known.starts_with(name)).unwrap();
        let path = directory.path().join(path);
        fs::write(&path, change(fs::read(&path).unwrap())).unwrap();
        Checkpoint::load(directory.path()).unwrap_err().to_string()
    };
    let cut = |bytes: Vec<u8>| bytes[..bytes.len() / 2].to_vec();
    assert!(spoil("weights", &cut).contains("expected"));
    let flip = |mut bytes: Vec<u8>| {
        *bytes.last_mut().unwrap() ^= 1;
        bytes
    };
    assert!(spoil("weights", &flip).contains("another checksum"));
    assert!(spoil("checkpoint.json", &cut).contains("not understood"));
    let later = |bytes: Vec<u8>| {
        String::from_utf8(bytes).unwrap().replace("\"format_version\": 1", "\"format_version\": 9").into_bytes()
    };
    assert!(spoil("checkpoint.json", &later).contains("it has format 9, this program reads 1"));
}

#[test]
fn statistics_that_cannot_be_are_refused() {
    let refusal = |pointer: &str, value: serde_json::Value| {
        let directory = tempfile::tempdir().unwrap();
        checkpoint(1, 1).save(directory.path()).unwrap();
        let path = directory.path().join(JSON);
        let mut document: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        *document.pointer_mut(pointer).unwrap() = value;
        fs::write(&path, document.to_string()).unwrap();
        let error = Checkpoint::load(directory.path()).unwrap_err();
        assert!(matches!(error, CheckpointError::Damaged { .. }), "{error}");
        error.to_string()
    };
    let observations = "/observation_normaliser/moments";
    for (pointer, value, part) in [
        (
            format!("{observations}/mean"),
            serde_json::json!([]),
            "observation_normaliser: mean has 0 numbers, expected 3",
        ),
        (format!("{observations}/squares"), serde_json::json!([1.0, 2.0]), "squares has 2 numbers, expected 3"),
        (format!("{observations}/squares"), serde_json::json!([1.0, -2.0, 3.0]), "squares holds -2"),
        (format!("{observations}/mean"), serde_json::json!([1.0, null, 3.0]), "not understood"),
        (format!("{observations}/count"), serde_json::json!(0), "count is 0, but there are statistics"),
        (format!("{observations}/count"), serde_json::json!(-1), "not understood"),
        (
            "/reward_normaliser/moments/mean".into(),
            serde_json::json!([0.0, 0.0]),
            "reward_normaliser: mean has 2 numbers",
        ),
        ("/reward_normaliser/gamma".into(), serde_json::json!(2.0), "reward_normaliser: gamma is 2"),
    ] {
        let message = refusal(&pointer, value);
        assert!(message.contains(part), "{pointer}: {message}");
    }
}
