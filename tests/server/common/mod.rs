//! Helpers for several test files: environments at their first episode, actions, and transcripts to compare.

pub mod proxy;
pub mod server;

use perturb::env::{
    Action, ActionSpec, Catalogue, DrawPurpose, EnvironmentSpec, EpisodeSettings, Episodes, Outcome, PhiloxStream,
    Version,
};

/// Returns the folders of examples/tasks, and a variant of the reaching arm whose last parameter is a length.
#[cfg(feature = "mujoco")]
pub fn folders() -> Vec<std::path::PathBuf> {
    static WITH_LENGTH: std::sync::OnceLock<std::path::PathBuf> = std::sync::OnceLock::new();
    let examples = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/tasks");
    let with_length = WITH_LENGTH.get_or_init(|| {
        let (arm, folder) =
            (examples.join("reaching_arm"), std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("stretched_arm"));
        let task =
            std::fs::read_to_string(arm.join("task.toml")).unwrap().replace("\"ReachingArm\"", "\"StretchedArm\"");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("task.toml"), task + UPPER_LENGTH).unwrap();
        std::fs::copy(arm.join("arm.xml"), folder.join("arm.xml")).unwrap();
        folder
    });
    [with_length.clone(), examples.join("quadruped"), examples.join("reaching_arm")].into()
}

/// A parameter of the reaching arm: the length of its upper link.
#[cfg(feature = "mujoco")]
pub const UPPER_LENGTH: &str = r#"
[[parameter]]
name = "upper_length"
unit = "m"
description = "length of the upper arm, whose mass follows, and at whose end the lower arm stays"
edit = [{ body = "upper", field = "length", by = "set" }]
bounds = [0.05, 1.0]
random = [0.3, 0.4]
extreme = [[0.25, 0.3], [0.4, 0.45]]
"#;

/// Returns the built-in environments, and the environments of the folders in examples/tasks.
pub fn catalogue() -> Catalogue {
    #[cfg(feature = "mujoco")]
    {
        static LOADED: std::sync::OnceLock<Catalogue> = std::sync::OnceLock::new();
        LOADED.get_or_init(|| perturb::tasks::catalogue_with(&folders()).unwrap()).clone()
    }
    #[cfg(not(feature = "mujoco"))]
    perturb::tasks::catalogue()
}

/// Returns the environments of the folders in examples/tasks.
#[cfg(feature = "mujoco")]
pub fn folder_specs() -> Vec<&'static EnvironmentSpec> {
    let built_in = perturb::tasks::catalogue();
    catalogue().specs().filter(|spec| built_in.names().all(|name| name != spec.name)).collect()
}

/// Returns settings of an environment in this version.
pub fn settings(spec: &EnvironmentSpec, version: Version, seed: u64, index: u32, per_trial: u32) -> EpisodeSettings {
    EpisodeSettings {
        seed,
        environment_index: index,
        distributions: spec.distributions(version).into(),
        episodes_per_trial: per_trial,
    }
}

/// Returns an environment at the start of its first episode.
pub fn episodes(spec: &EnvironmentSpec, version: Version, seed: u64, index: u32, per_trial: u32) -> Episodes {
    Episodes::new((spec.make)().unwrap(), settings(spec, version, seed, index, per_trial))
}

/// Returns the encoded action of actor number `actor` at time `t`: random, but a function of these two numbers only.
/// Continuous actions sometimes exceed their ranges, which is allowed.
pub fn action_bytes(spec: &EnvironmentSpec, actor: u64, t: u64) -> Vec<u8> {
    let mut stream = PhiloxStream::new(0xAC7, actor, DrawPurpose::InitialState, t);
    match spec.action {
        ActionSpec::Discrete(names) => ((stream.unit() * names.len() as f64) as i32).to_le_bytes().to_vec(),
        ActionSpec::Continuous(channels) => {
            channels.iter().flat_map(|c| (stream.uniform(1.2 * c.low, 1.2 * c.high) as f32).to_le_bytes()).collect()
        }
    }
}

/// Decodes little-endian f32 values.
pub fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|word| f32::from_le_bytes(*word)).collect()
}

/// Takes a step with an encoded action. Also returns the terms of the reward.
pub fn step(episodes: &mut Episodes, action: &[u8]) -> (Outcome, Vec<f64>) {
    let mut terms = vec![f64::NAN; episodes.spec().reward_terms.len()];
    let outcome = match episodes.spec().action {
        ActionSpec::Discrete(_) => {
            episodes.step(Action::Discrete(u32::from_le_bytes(action.try_into().unwrap())), &mut terms)
        }
        ActionSpec::Continuous(_) => episodes.step(Action::Continuous(&floats(action)), &mut terms),
    };
    (outcome, terms)
}

/// Returns the current observation.
pub fn observe(episodes: &Episodes) -> Vec<f32> {
    let mut out = vec![f32::NAN; episodes.spec().observation.len()];
    episodes.observe(&mut out);
    out
}

/// Describes the start of an episode in one line: its indices, its physics, its first observation. Numbers are printed
/// with all digits, so equal lines mean equal bytes.
pub fn start_line(episodes: &Episodes) -> String {
    format!("start {:?} {:?}", episodes.started(true), observe(episodes))
}

/// Takes `steps` steps of the actor from time `from` on, and begins a new episode after each end. Returns lines with
/// all outputs.
pub fn play(episodes: &mut Episodes, actor: u64, from: u64, steps: u64) -> Vec<String> {
    let mut lines = Vec::new();
    for t in from..from + steps {
        if episodes.ended() {
            episodes.begin(None);
            lines.push(start_line(episodes));
        }
        let (outcome, terms) = step(episodes, &action_bytes(episodes.spec(), actor, t));
        lines.push(format!("{t} {outcome:?} {terms:?} {:?}", observe(episodes)));
        if episodes.ended() {
            lines.push(format!("end {:?}", episodes.finished(true)));
        }
    }
    lines
}
