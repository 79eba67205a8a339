use std::fs;

use bytes::Bytes;
use rand::Rng;

use super::*;
use crate::algorithm::AlgorithmState;
use crate::logging::{EpisodeFigures, LogLengths, TimeShares};
use crate::policy::Policy;
use crate::rollout::CollectorState;
use perturb_policy::NamedArray;
use perturb_policy::PlayerState;
use perturb_policy::random::{Purpose, stream};

fn checkpoint(seed: u64, iterations: u64) -> Checkpoint {
    // Odd seeds feed-forward, even ones recurrent.
    let architecture = if seed.is_multiple_of(2) { "rc" } else { "ff" };
    let mut normaliser = ObservationNormaliser::new(3);
    normaliser.update(&[0.1, 1e-7, -3.0, 0.3, 2e-7, 5.0]).unwrap();
    let config =
        format!("environment = 'Toy'\nversion = 'R'\nseed = {seed}\narchitecture = '{architecture}'\nnum_envs = 2");
    let state = State {
        environment_spec: EnvironmentSummary {
            revision: 1,
            step_limit: 10,
            observation: vec!["x".into(), "y".into(), "z".into()],
            action: ActionKind::Continuous { size: 2 },
            parameters: vec!["mass".into()],
            applied: Vec::new(),
            model_hash: String::new(),
        },
        observation_normaliser: Some(normaliser),
        reward_normaliser: Some(RewardNormaliser::new(2, 0.99)),
        counters: Counters { iterations, timesteps: 7, episodes: 3, generated_episodes: 4, learned_timesteps: 5 },
        config: TrainConfig::from_table("test", config.parse().unwrap()).unwrap(),
        commits: vec!["0.1.0 (a)".into()],
    };
    let policy = state.policy();
    let weights = Policy::new(policy.clone(), seed).unwrap().weights();
    Checkpoint { state, policy, weights }
}

/// Of two environments; snapshots differ in length, floats are none that text would round well.
fn resume_state(seed: u64) -> ResumeState {
    let mut rng = stream(seed, Purpose::Actions);
    for _ in 0..seed {
        rng.next_u32(); // within a block
    }
    let array = |name: &str| NamedArray { name: name.into(), shape: vec![3], data: vec![0.1, -1e-38, 1.0 / 3.0] };
    let recurrent = seed.is_multiple_of(2);
    ResumeState {
        collector: CollectorState {
            snapshots: vec![Bytes::from_static(b"\0one"), Bytes::from(vec![255; seed as usize])],
            player: PlayerState {
                observations: vec![0.1, f32::MIN_POSITIVE, -3.0, 1e-7, 10.0, seed as f32],
                starts: vec![true, false],
                outcomes: vec![0.5; 6],
                memory: if recurrent { vec![0.25; 12] } else { vec![] },
                actions: rng.clone(),
            },
        },
        algorithm: AlgorithmState {
            n_updates: 1 << 40,
            iterations: 12,
            optimiser: vec![array("mean"), array("mean_square")],
            rng: recurrent.then_some(rng),
        },
        history: History {
            recent: vec![
                EpisodeFigures { episode_return: 0.1 + 0.2, length: 200.0, success: 1.0 },
                EpisodeFigures { episode_return: -1e-300, length: 1.0, success: 0.0 },
            ],
            elapsed: 1.0 / 3.0,
            shares: TimeShares { acting: 0.1, waiting: 0.2, updating: 0.3 },
            logs: LogLengths { monitor: 1, progress: 2, events: 3, events_file: "events.out.tfevents.7".into() },
        },
    }
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
        saved.save(&run.path().join("checkpoint"), None).unwrap();
        assert_eq!(Checkpoint::load(run.path()).unwrap(), saved);
        assert_eq!(Checkpoint::load(&run.path().join("checkpoint")).unwrap(), saved);
    }
}

#[test]
fn what_resuming_needs_is_saved_and_loaded_bit_for_bit() {
    let directory = tempfile::tempdir().unwrap();
    for seed in [1, 2, 3] {
        let (saved, state) = (checkpoint(seed, seed), resume_state(seed));
        saved.save(directory.path(), Some(&state)).unwrap();
        let (loaded, mut loaded_state) = Checkpoint::load_with_resume(directory.path()).unwrap();
        assert_eq!((&loaded, &loaded_state), (&saved, &state));
        assert_eq!(loaded_state.collector.player.actions.next_u64(), state.collector.player.actions.clone().next_u64());
    }
}

#[test]
fn a_checkpoint_without_the_state_of_its_training_can_be_tested_but_not_resumed() {
    let directory = tempfile::tempdir().unwrap();
    checkpoint(1, 1).save(directory.path(), Some(&resume_state(1))).unwrap();
    checkpoint(1, 2).save(directory.path(), None).unwrap();
    assert_eq!(names(directory.path()).len(), 2, "the earlier state is gone");
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), checkpoint(1, 2));
    let error = Checkpoint::load_with_resume(directory.path()).unwrap_err();
    assert!(matches!(error, CheckpointError::NotResumable { .. }), "{error}");
    assert!(error.to_string().contains("can be tested but not resumed"), "{error}");
}

#[test]
fn only_the_current_arrays_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    checkpoint(1, 1).save(directory.path(), Some(&resume_state(1))).unwrap();
    fs::write(directory.path().join(".tmp-checkpoint.json"), "left by a crash").unwrap();
    checkpoint(2, 2).save(directory.path(), Some(&resume_state(2))).unwrap();
    let names = names(directory.path());
    assert_eq!(names.len(), 3, "{names:?}");
    assert_eq!(names[0], "checkpoint.json");
    assert!(names[1].starts_with("resume-00000002-"));
    assert!(names[2].starts_with("weights-00000002-"));
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), checkpoint(2, 2));
}

/// Every state of the directory that a crash during a save can leave.
#[test]
fn a_crash_at_any_moment_leaves_a_whole_checkpoint() {
    let (old, new) = ((checkpoint(1, 1), resume_state(1)), (checkpoint(2, 2), resume_state(2)));
    let after = tempfile::tempdir().unwrap();
    new.0.save(after.path(), Some(&new.1)).unwrap();
    let after_names = names(after.path());
    let [new_json, new_resume, new_weights] =
        std::array::from_fn(|i| fs::read(after.path().join(&after_names[i])).unwrap());

    let load_with = |files: &[(&str, &[u8])]| {
        let directory = tempfile::tempdir().unwrap();
        old.0.save(directory.path(), Some(&old.1)).unwrap();
        for (name, content) in files {
            fs::write(directory.path().join(name), content).unwrap();
        }
        let loaded = Checkpoint::load_with_resume(directory.path()).unwrap();
        // A later save finds its way out of any of them.
        new.0.save(directory.path(), Some(&new.1)).unwrap();
        assert_eq!(names(directory.path()), after_names);
        loaded
    };
    let [resume, weights] = [after_names[1].as_str(), after_names[2].as_str()];
    let (temporary_resume, temporary_weights) = (format!(".tmp-{resume}"), format!(".tmp-{weights}"));
    let mut files: Vec<(&str, &[u8])> = Vec::new();
    assert_eq!(load_with(&[(&temporary_resume, &new_resume[..10])]), old);
    assert_eq!(load_with(&[(&temporary_resume, &new_resume)]), old);
    files.push((resume, &new_resume));
    assert_eq!(load_with(&files), old);
    assert_eq!(load_with(&[&files[..], &[(&temporary_weights, &new_weights[..10])]].concat()), old);
    assert_eq!(load_with(&[&files[..], &[(&temporary_weights, &new_weights)]].concat()), old);
    files.push((weights, &new_weights));
    assert_eq!(load_with(&files), old);
    assert_eq!(load_with(&[&files[..], &[(".tmp-checkpoint.json", &new_json[..50])]].concat()), old);
    files.push((JSON, &new_json));
    assert_eq!(load_with(&files), new);
}

#[test]
fn damage_is_named() {
    let empty = tempfile::tempdir().unwrap();
    assert!(Checkpoint::load(empty.path()).unwrap_err().to_string().contains("holds no checkpoint"));

    let spoil = |name: &str, change: &dyn Fn(Vec<u8>) -> Vec<u8>| {
        let directory = tempfile::tempdir().unwrap();
        checkpoint(1, 1).save(directory.path(), Some(&resume_state(1))).unwrap();
        let path = names(directory.path()).into_iter().find(|known| known.starts_with(name)).unwrap();
        let path = directory.path().join(path);
        fs::write(&path, change(fs::read(&path).unwrap())).unwrap();
        assert_eq!(Checkpoint::load(directory.path()).is_ok(), name == "resume", "testing looks at what it needs");
        Checkpoint::load_with_resume(directory.path()).unwrap_err().to_string()
    };
    let cut = |bytes: Vec<u8>| bytes[..bytes.len() / 2].to_vec();
    assert!(spoil("weights", &cut).contains("expected"));
    let flip = |mut bytes: Vec<u8>| {
        *bytes.last_mut().unwrap() ^= 1;
        bytes
    };
    assert!(spoil("weights", &flip).contains("another checksum"));
    assert!(spoil("resume", &cut).contains("expected"));
    assert!(spoil("resume", &flip).contains("another checksum"));
    assert!(spoil("checkpoint.json", &cut).contains("not understood"));
    let later = |bytes: Vec<u8>| {
        String::from_utf8(bytes).unwrap().replace("\"format_version\": 2", "\"format_version\": 9").into_bytes()
    };
    assert!(spoil("checkpoint.json", &later).contains("it has format 9, this program reads 1 to 2"));
}

#[test]
fn statistics_that_cannot_be_are_refused() {
    let refusal = |pointer: &str, value: serde_json::Value| {
        let directory = tempfile::tempdir().unwrap();
        checkpoint(1, 1).save(directory.path(), None).unwrap();
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
    let directory = tempfile::tempdir().unwrap();
    let mut other = checkpoint(1, 1);
    other.state.reward_normaliser = other.state.reward_normaliser.map(|normaliser| normaliser.running_on(true));
    other.save(directory.path(), None).unwrap();
    let message = Checkpoint::load(directory.path()).unwrap_err().to_string();
    assert!(message.contains("runs_on is true, but reward_return_runs_on false in the configuration"), "{message}");
}

#[test]
fn a_changed_environment_is_told_from_the_one_that_was_trained_in() {
    let trained = checkpoint(1, 1).state.environment_spec;
    assert_eq!(trained.difference(&trained), None);
    let mut served = trained.clone();
    served.step_limit = 11;
    assert_eq!(trained.difference(&served), Some(("step limit", "10".into(), "11".into())));
    served.model_hash = "abc".into();
    assert_eq!(trained.difference(&served), Some(("model", "\"\"".into(), "\"abc\"".into())));
    served.revision = 2;
    assert_eq!(trained.difference(&served), Some(("revision", "1".into(), "2".into())));
}
