//! The default settings of every pair of algorithm and architecture, in each preset. docs/algorithms.md gives the
//! reasons, with measured success rates. The defaults were chosen in trainings with seed 1.

use perturb_protocol::Version;

use super::preset::{self, Preset};
use super::{Architecture, Base, Common, Settings, TrainConfig, Wrapper};

/// Returns the default configuration for the algorithm of `settings`. It has no environment yet.
pub(super) fn defaults_for(mut settings: Settings, architecture: Architecture, preset: Preset) -> TrainConfig {
    tune(&mut settings, architecture);
    let num_envs = match (&settings.wrapper, &settings.base, architecture) {
        (Wrapper::Epopt(_), _, _) => 25,
        (_, Base::Random | Base::Heuristic, _) => 1,
        (_, Base::Ppo(_), Architecture::Ff) => 8,
        _ => 16,
    };
    let log_interval = match (&settings.wrapper, &settings.base) {
        (Wrapper::Plain | Wrapper::Rl2(_), Base::A2c(_)) => 100,
        _ => 1,
    };
    let learns = settings.learns();
    let common = Common {
        preset: Preset::Perturb,
        environment: String::new(),
        version: Version::D,
        parameters: Default::default(),
        contexts: Vec::new(),
        architecture,
        observe: Default::default(),
        episodes: 15_000,
        seed: 1,
        num_envs,
        normalize_observations: learns,
        normalize_rewards: learns,
        reward_return_runs_on: false,
        log_interval,
        checkpoint_interval: 500,
        stop_at_success: 0.0,
        observation_noise: 0.0,
    };
    let mut config = TrainConfig { common, settings };
    if preset == Preset::Paper {
        preset::apply_paper(&mut config);
    }
    config
}

fn tune(settings: &mut Settings, architecture: Architecture) {
    match &mut settings.base {
        Base::A2c(a2c) => {
            (a2c.learning_rate, a2c.n_steps, a2c.ent_coef) = match (&settings.wrapper, architecture) {
                // The learning rate is high, because a whole training has only a few hundred updates.
                (Wrapper::Epopt(_), Architecture::Ff) => (7e-2, a2c.n_steps, 1e-4),
                (Wrapper::Epopt(_) | Wrapper::Rl2(_), _) => (7e-3, 15, 1e-4),
                (Wrapper::Plain, _) => (7e-3, 15, 1e-3),
            };
        }
        Base::Ppo(ppo) => {
            match settings.wrapper {
                Wrapper::Plain => {}
                Wrapper::Epopt(_) => ppo.learning_rate = 3e-3,
                Wrapper::Rl2(_) => (ppo.gae_lambda, ppo.kl_coef) = (0.97, 0.2),
            }
            if architecture == Architecture::Rc {
                ppo.n_epochs = 4; // an epoch takes five times as long as with a feed-forward policy
            }
        }
        Base::Random | Base::Heuristic => {}
    }
}
