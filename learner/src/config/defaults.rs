//! The defaults of every pair of algorithm and architecture. Why they are what they are: docs/algorithms.md.

use super::{AlgorithmName, Architecture, Base, BaseSettings, Common, Settings, Wrapper, WrapperSettings};
use crate::evaluation::Version;

/// What every training has, without an environment.
pub(super) fn common(algorithm: AlgorithmName, architecture: Architecture) -> Common {
    let (num_envs, log_interval) = match (algorithm.wrapper(), algorithm.base()) {
        (Wrapper::Epopt, _) => (25, 1),
        (_, Base::A2c) => (16, 100),
        (_, Base::Ppo) => (8, 1),
    };
    Common {
        environment: String::new(),
        version: Version::D,
        algorithm,
        architecture,
        episodes: 15_000,
        seed: 1,
        num_envs,
        normalize_observations: true,
        normalize_rewards: true,
        log_interval,
        checkpoint_interval: 500,
    }
}

/// The settings of the algorithm.
pub(super) fn settings(algorithm: AlgorithmName, _architecture: Architecture) -> Settings {
    let mut base = BaseSettings::of(algorithm.base());
    if let (Wrapper::Rl2, BaseSettings::Ppo(settings)) = (algorithm.wrapper(), &mut base) {
        settings.gae_lambda = 0.97;
    }
    Settings { base, wrapper: WrapperSettings::of(algorithm.wrapper()) }
}
