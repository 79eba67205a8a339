use std::fs;

use bytes::Bytes;
use perturb_policy::NamedArray;
use perturb_policy::random::{Purpose, stream};
use rand::Rng;

use super::*;

/// Returns a checkpoint of a shipped policy, with changed counters and a changed weight.
fn checkpoint(seed: u64, iterations: u64) -> Checkpoint {
    let policies = Path::new(env!("CARGO_MANIFEST_DIR")).join("../results/policies");
    let mut checkpoint = Checkpoint::load(&policies.join("Acrobot-ppo-ff-D-9bd6546b-s10.safetensors")).unwrap();
    checkpoint.state.counters.iterations = iterations;
    checkpoint.weights[0].data[0] = seed as f32;
    checkpoint
}

/// Returns the resume state of a training with two environments. Its snapshots differ in length, and its floats need
/// all their digits.
fn resume_state(seed: u64) -> ResumeState {
    let mut rng = stream(seed, Purpose::Actions);
    for _ in 0..seed {
        rng.next_u32(); // the stream's position is within a block
    }
    let array = |name: &str| NamedArray { name: name.into(), shape: vec![3], data: vec![0.1, -1e-38, 1.0 / 3.0] };
    let recurrent = seed.is_multiple_of(2);
    ResumeState {
        collector: CollectorState {
            snapshots: vec![Bytes::from_static(b"\0one"), Bytes::from(vec![255; seed as usize])],
            player: PlayerTrainingState {
                observations: vec![0.1, f32::MIN_POSITIVE, -3.0, 1e-7, 10.0, seed as f32],
                starts: vec![true, false],
                previous_steps: vec![0.5; 6],
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
fn what_resuming_needs_is_saved_and_loaded_bit_for_bit() {
    let directory = tempfile::tempdir().unwrap();
    for seed in [1, 2, 3] {
        let saved = checkpoint(seed, seed);
        let state = resume_state(seed);
        state.save(&saved, directory.path()).unwrap();
        let (loaded, mut loaded_state) = ResumeState::load(directory.path()).unwrap();
        assert_eq!((&loaded, &loaded_state), (&saved, &state));
        assert_eq!(loaded_state.collector.player.actions.next_u64(), state.collector.player.actions.clone().next_u64());
    }
}

#[test]
fn checkpoint_without_resume_state_can_only_be_tested() {
    let directory = tempfile::tempdir().unwrap();
    resume_state(1).save(&checkpoint(1, 1), directory.path()).unwrap();
    checkpoint(1, 2).save(directory.path(), None).unwrap();
    assert_eq!(names(directory.path()).len(), 2, "the earlier state is gone");
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), checkpoint(1, 2));
    let error = ResumeState::load(directory.path()).unwrap_err();
    assert!(matches!(error, CheckpointError::NotResumable { .. }), "{error}");
    assert!(error.to_string().contains("can be tested but not resumed"), "{error}");
}

#[test]
fn only_the_current_arrays_are_kept() {
    let directory = tempfile::tempdir().unwrap();
    resume_state(1).save(&checkpoint(1, 1), directory.path()).unwrap();
    fs::write(directory.path().join(".tmp-checkpoint.json"), "left by a crash").unwrap();
    resume_state(2).save(&checkpoint(2, 2), directory.path()).unwrap();
    let names = names(directory.path());
    assert_eq!(names.len(), 3, "{names:?}");
    assert_eq!(names[0], "checkpoint.json");
    assert!(names[1].starts_with("resume-00000002-"));
    assert!(names[2].starts_with("weights-00000002-"));
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), checkpoint(2, 2));
}

/// Tries every state of the directory that a crash during a save can leave.
#[test]
fn a_crash_at_any_moment_leaves_a_whole_checkpoint() {
    let old = (checkpoint(1, 1), resume_state(1));
    let new = (checkpoint(2, 2), resume_state(2));
    let after = tempfile::tempdir().unwrap();
    new.1.save(&new.0, after.path()).unwrap();
    let after_names = names(after.path());
    let [new_json, new_resume, new_weights] =
        std::array::from_fn(|i| fs::read(after.path().join(&after_names[i])).unwrap());

    let load_with = |files: &[(&str, &[u8])]| {
        let directory = tempfile::tempdir().unwrap();
        old.1.save(&old.0, directory.path()).unwrap();
        for (name, content) in files {
            fs::write(directory.path().join(name), content).unwrap();
        }
        let loaded = ResumeState::load(directory.path()).unwrap();
        // A later save succeeds from each of these states.
        new.1.save(&new.0, directory.path()).unwrap();
        assert_eq!(names(directory.path()), after_names);
        loaded
    };
    let [resume, weights] = [after_names[1].as_str(), after_names[2].as_str()];
    let temporary_resume = format!(".tmp-{resume}");
    let temporary_weights = format!(".tmp-{weights}");
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
        resume_state(1).save(&checkpoint(1, 1), directory.path()).unwrap();
        let path = names(directory.path()).into_iter().find(|known| known.starts_with(name)).unwrap();
        let path = directory.path().join(path);
        fs::write(&path, change(fs::read(&path).unwrap())).unwrap();
        assert_eq!(Checkpoint::load(directory.path()).is_ok(), name == "resume", "testing looks at what it needs");
        ResumeState::load(directory.path()).unwrap_err().to_string()
    };
    let cut = |bytes: Vec<u8>| bytes[..bytes.len() / 2].to_vec();
    assert!(spoil("weights", &cut).contains("expected"));
    let flip = |mut bytes: Vec<u8>| {
        *bytes.last_mut().unwrap() ^= 1;
        bytes
    };
    assert!(spoil("weights", &flip).contains("the checksum does not match"));
    assert!(spoil("resume", &cut).contains("expected"));
    assert!(spoil("resume", &flip).contains("the checksum does not match"));
    assert!(spoil("checkpoint.json", &cut).contains("not understood"));
    let later = |bytes: Vec<u8>| {
        String::from_utf8(bytes).unwrap().replace("\"format_version\": 3", "\"format_version\": 9").into_bytes()
    };
    assert!(spoil("checkpoint.json", &later).contains("has format 9, and this program reads 1 to 3"));
}
