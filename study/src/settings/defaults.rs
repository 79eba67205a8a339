//! The defaults of every pair of algorithm and architecture. Why they are what they are, with numbers:
//! docs/algorithms.md.

use super::{AlgorithmName, Architecture, Base, BaseSettings, Common, Settings, Wrapper, WrapperSettings};
use perturb_protocol::Version;

/// What every training has, without an environment.
pub(super) fn common(algorithm: AlgorithmName, architecture: Architecture) -> Common {
    let num_envs = match (algorithm.wrapper(), algorithm.base(), architecture) {
        (Wrapper::Epopt, _, _) => 25,
        (_, Base::Ppo, Architecture::Ff) => 8,
        _ => 16,
    };
    let log_interval = match (algorithm.wrapper(), algorithm.base()) {
        (Wrapper::Plain | Wrapper::Rl2, Base::A2c) => 100,
        _ => 1,
    };
    Common {
        environment: String::new(),
        version: Version::D,
        parameters: Default::default(),
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
pub(super) fn settings(algorithm: AlgorithmName, architecture: Architecture) -> Settings {
    let mut base = BaseSettings::of(algorithm.base());
    match &mut base {
        BaseSettings::A2c(settings) => {
            (settings.learning_rate, settings.n_steps, settings.ent_coef) = match (algorithm.wrapper(), architecture) {
                // A few hundred updates are all that there are.
                (Wrapper::Epopt, Architecture::Ff) => (7e-2, settings.n_steps, 1e-4),
                (Wrapper::Epopt | Wrapper::Rl2, _) => (7e-3, 15, 1e-4),
                (Wrapper::Plain, _) => (7e-3, 15, 1e-3),
            };
        }
        BaseSettings::Ppo(settings) => {
            if algorithm.wrapper() == Wrapper::Epopt {
                settings.learning_rate = 3e-3;
            }
            if architecture == Architecture::Rc {
                settings.n_epochs = 4; // an epoch costs five times as much as that of a feed-forward policy
            }
            if algorithm.wrapper() == Wrapper::Rl2 {
                (settings.gae_lambda, settings.kl_coef) = (0.97, 0.2);
            }
        }
    }
    Settings { base, wrapper: WrapperSettings::of(algorithm.wrapper()) }
}
