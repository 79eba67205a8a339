use std::fs;
use std::path::PathBuf;

use perturb_files as files;
use perturb_policy::random::{Purpose, stream};
use perturb_policy::{ActionKind, NamedArray};
use rand::Rng;

use super::*;

fn checkpoint(seed: u64, iterations: u64) -> Checkpoint {
    // Odd seeds give a feed-forward policy, even seeds a recurrent one.
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
    let mut rng = stream(seed, Purpose::Weights);
    let array = |(name, shape): (String, Vec<usize>)| {
        let data = (0..shape.iter().product()).map(|_| rng.next_u32() as f32 * 1e-9).collect();
        NamedArray { name, shape, data }
    };
    let weights = policy.layout().into_iter().map(array).collect();
    Checkpoint { state, policy, weights }
}

/// Returns the paths of all trained policies in the repository.
fn shipped() -> impl Iterator<Item = PathBuf> {
    let policies = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../results/policies");
    files::list(&policies).unwrap().into_iter()
}

#[test]
fn shipped_policies_are_read_and_saved_under_their_names() {
    let mut environments = std::collections::BTreeSet::new();
    for path in shipped() {
        let policy = Checkpoint::load(&path).unwrap();
        let folder = tempfile::tempdir().unwrap();
        policy.save(folder.path(), None).unwrap();
        // The name of the file of weights contains the weights' checksum.
        let weights = format!("weights-{}.safetensors", policy.id().unwrap());
        assert!(folder.path().join(&weights).is_file(), "{weights}");
        let copy = folder.path().join("copy.safetensors");
        Checkpoint::load(folder.path()).unwrap().save_file(&copy).unwrap();
        assert_eq!(files::read(&copy).unwrap(), files::read(&path).unwrap(), "the same bytes");
        policy.player(3, 1, 0).unwrap();
        environments.insert(policy.state.config.common.environment);
    }
    assert!(environments.len() > 2, "{environments:?}");
}

#[test]
fn a_policy_file_is_whole_or_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("policy.safetensors");
    let saved = checkpoint(1, 1);
    saved.save_file(&path).unwrap();
    assert_eq!(Checkpoint::load(&path).unwrap(), saved);
    let whole = files::read(&path).unwrap();
    for at in (0..whole.len()).step_by(97) {
        let mut other = whole.clone();
        other[at] ^= 1;
        fs::write(&path, other).unwrap();
        if let Ok(loaded) = Checkpoint::load(&path) {
            assert_eq!(loaded, saved, "byte {at}");
        }
    }
    let mut other = whole.clone();
    *other.last_mut().unwrap() ^= 1;
    fs::write(&path, other).unwrap();
    assert!(Checkpoint::load(&path).unwrap_err().to_string().contains("the checksum does not match"));
    fs::write(&path, encode_weights(&saved.weights).unwrap()).unwrap();
    let message = Checkpoint::load(&path).unwrap_err().to_string();
    assert!(message.contains("its metadata have no `perturb`"), "{message}");
    assert!(Checkpoint::load_resumable(&path).unwrap_err().to_string().contains("holds no checkpoint"));
}

#[test]
fn checkpoint_loads_bit_for_bit_from_run_or_folder() {
    let run = tempfile::tempdir().unwrap();
    for seed in [1, 2] {
        let saved = checkpoint(seed, seed);
        saved.save(&run.path().join("checkpoint"), None).unwrap();
        assert_eq!(Checkpoint::load(run.path()).unwrap(), saved);
        assert_eq!(Checkpoint::load(&run.path().join("checkpoint")).unwrap(), saved);
    }
}

#[test]
fn the_state_is_read_without_the_weights_which_must_be_there() {
    let run = tempfile::tempdir().unwrap();
    let (saved, directory) = (checkpoint(1, 1), run.path().join("checkpoint"));
    saved.save(&directory, None).unwrap();
    assert_eq!(State::load(run.path()).unwrap(), saved.state);
    let weights = files::list(&directory).unwrap().into_iter().find(|path| !path.ends_with(JSON));
    let weights = weights.unwrap();
    let length = std::fs::metadata(&weights).unwrap().len();
    std::fs::write(&weights, vec![0; length as usize]).unwrap();
    assert_eq!(State::load(run.path()).unwrap(), saved.state, "they are not looked into");
    std::fs::write(&weights, "x").unwrap();
    assert!(State::load(run.path()).unwrap_err().to_string().contains("it has 1 bytes, expected"));
    std::fs::remove_file(&weights).unwrap();
    assert!(State::load(run.path()).unwrap_err().to_string().contains("cannot read"));
}

#[test]
fn damage_is_named() {
    let empty = tempfile::tempdir().unwrap();
    assert!(Checkpoint::load(empty.path()).unwrap_err().to_string().contains("holds no checkpoint"));

    let from = tempfile::tempdir().unwrap();
    Checkpoint::load(&shipped().next().unwrap()).unwrap().save(from.path(), None).unwrap();
    let from = from.path();
    let spoil = |name: &str, change: &dyn Fn(String, Vec<u8>) -> Vec<u8>| {
        let copy = tempfile::tempdir().unwrap();
        for path in files::list(from).unwrap() {
            let file = path.file_name().unwrap().to_string_lossy().into_owned();
            let content = files::read(&path).unwrap();
            let spoiled = file.starts_with(name);
            let text = String::from_utf8_lossy(&content).into_owned();
            std::fs::write(copy.path().join(&file), if spoiled { change(text, content) } else { content }).unwrap();
        }
        Checkpoint::load(copy.path()).unwrap_err().to_string()
    };
    let replaced = |from: &'static str, to: &'static str| {
        move |text: String, _| {
            assert!(text.contains(from), "{from}");
            // Writes changed content with its correct checksum.
            let mut document = serde_json::from_str(&text.replacen(from, to, 1)).unwrap();
            checksum::open(&mut document).unwrap_err();
            serde_json::to_vec_pretty(&WithChecksum::new(&document).unwrap()).unwrap()
        }
    };
    assert!(spoil("weights", &|_, bytes| bytes[..bytes.len() / 2].to_vec()).contains("expected"));
    let flip = |_, mut bytes: Vec<u8>| {
        *bytes.last_mut().unwrap() ^= 1;
        bytes
    };
    assert!(spoil("weights", &flip).contains("the checksum does not match"));
    assert!(spoil("checkpoint", &|_, bytes| bytes[..bytes.len() / 2].to_vec()).contains("not understood"));
    let later = replaced("\"format_version\": 3", "\"format_version\": 9");
    assert!(spoil("checkpoint", &later).contains("has format 9, and this program reads 1 to 3"));
    // The weights do not fit another architecture, even if their checksum is correct.
    let other = replaced("\"architecture\": \"ff\"", "\"architecture\": \"rc\"");
    let message = spoil("checkpoint", &other);
    assert!(message.contains("arrays, expected"), "{message}");
    let statistics = replaced("\"observation_normaliser\": {", "\"observation_normaliser\": null, \"left\": {");
    assert!(spoil("checkpoint", &statistics).contains("observation_normaliser: there is none"));
}

/// A change of any byte of the JSON document must be noticed, because for instance the normalisers' statistics are in
/// no other file.
#[test]
fn no_byte_of_the_json_changes_a_checkpoint_unnoticed() {
    let directory = tempfile::tempdir().unwrap();
    let saved = checkpoint(1, 1);
    saved.save(directory.path(), None).unwrap();
    let path = directory.path().join(JSON);
    let text = fs::read(&path).unwrap();
    let mut refused = 0;
    for at in 0..text.len() {
        let mut other = text.clone();
        other[at] ^= 1;
        fs::write(&path, other).unwrap();
        match Checkpoint::load(directory.path()) {
            // A change is accepted if it has no effect, such as a changed space, or a last digit that rounds to the
            // same number.
            Ok(loaded) => assert!(loaded == saved, "byte {at}, {:?}", text[at] as char),
            Err(_) => refused += 1,
        }
    }
    assert!(refused > text.len() / 2, "{refused} of {}", text.len());

    // A document of the current format without a checksum is an error. A document of an earlier format with a checksum
    // is an error, too.
    let mut document: serde_json::Value = serde_json::from_slice(&text).unwrap();
    document["format_version"] = 2.into();
    fs::write(&path, document.to_string()).unwrap();
    assert!(Checkpoint::load(directory.path()).unwrap_err().to_string().contains("the checksum does not match"));
    document.as_object_mut().unwrap().remove("crc32c");
    fs::write(&path, document.to_string()).unwrap();
    assert_eq!(Checkpoint::load(directory.path()).unwrap(), saved, "earlier programs wrote none");
    document["format_version"] = 3.into();
    fs::write(&path, document.to_string()).unwrap();
    assert!(Checkpoint::load(directory.path()).unwrap_err().to_string().contains("the checksum does not match"));
}

#[test]
fn statistics_that_cannot_be_are_refused() {
    let refusal = |pointer: &str, value: serde_json::Value| {
        let directory = tempfile::tempdir().unwrap();
        checkpoint(1, 1).save(directory.path(), None).unwrap();
        let path = directory.path().join(JSON);
        let mut document: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
        *document.pointer_mut(pointer).unwrap() = value;
        checksum::open(&mut document).unwrap_err();
        fs::write(&path, serde_json::to_vec(&WithChecksum::new(&document).unwrap()).unwrap()).unwrap();
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
fn changed_environment_is_detected() {
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

#[test]
fn only_plain_files_of_the_right_length_are_read() {
    let run = tempfile::tempdir().unwrap();
    let saved = checkpoint(1, 1);
    saved.save(run.path(), None).unwrap();
    let find = |json: bool| {
        let paths = files::list(run.path()).unwrap();
        paths.into_iter().find(|path| path.ends_with(JSON) == json).unwrap()
    };
    let refused = || {
        let errors = [Checkpoint::load(run.path()).unwrap_err(), State::load(run.path()).unwrap_err()];
        errors.map(|error| error.to_string())
    };
    let weights = find(false);
    fs::remove_file(&weights).unwrap();
    for make in ["ln -s /dev/zero", "mkfifo"] {
        let mut words = make.split(' ');
        let mut command = std::process::Command::new(words.next().unwrap());
        assert!(command.args(words).arg(&weights).status().unwrap().success());
        assert!(refused().iter().all(|error| error.contains("it is a pipe or a device")), "{:?}", refused());
        fs::remove_file(&weights).unwrap();
    }
    fs::File::create(&weights).unwrap().set_len(1 << 40).unwrap(); // a terabyte of nothing
    assert!(refused().iter().all(|error| error.contains("it has 1099511627776 bytes, expected")), "{:?}", refused());
}

#[test]
fn a_checkpoint_is_read_while_it_is_replaced_again_and_again() {
    let run = tempfile::tempdir().unwrap();
    let mut saved = checkpoint(1, 1);
    saved.save(run.path(), None).unwrap();
    let path = run.path().to_owned();
    let is_done = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let done = std::sync::Arc::clone(&is_done);
    let writer = std::thread::spawn(move || {
        while !done.load(std::sync::atomic::Ordering::Relaxed) {
            saved.state.counters.iterations += 1;
            saved.save(&path, None).unwrap();
        }
    });
    for _ in 0..300 {
        Checkpoint::load(run.path()).unwrap();
        State::load(run.path()).unwrap();
    }
    is_done.store(true, std::sync::atomic::Ordering::Relaxed);
    writer.join().unwrap();
}
