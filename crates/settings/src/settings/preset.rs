//! Presets of default settings: the recommended ones, or those that Packer et al. (2018) published.

use std::fmt;

use serde::{Deserialize, Serialize};
use toml::Table;

use super::{Architecture, Base, Ranking, TrainConfig, Wrapper};

/// A preset, which chooses the default settings. Each setting that differs between presets can also be given
/// individually. docs/algorithms.md lists these settings, with their locations in the code of Packer et al. (2018).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// The recommended settings.
    #[default]
    Perturb,
    /// The settings of Packer et al. (2018), as far as they are published in their code: sunblaze-ucb/rl-generalization
    /// at 5e05aa1 with openai/baselines at 2b0283b.
    Paper,
}

impl Preset {
    /// Both presets.
    pub const ALL: [Self; 2] = [Self::Perturb, Self::Paper];
    /// The names of the presets in settings and on the command line.
    pub const NAMES: [&'static str; 2] = ["perturb", "paper"];

    /// Returns whether this is the default preset.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(Self::NAMES[*self as usize])
    }
}

/// Replaces the defaults of an algorithm by the values of Packer et al. (2018).
pub(super) fn apply_paper(TrainConfig { common, settings }: &mut TrainConfig) {
    common.preset = Preset::Paper;
    common.num_envs = 1;
    common.reward_return_runs_on = true;
    match &mut settings.base {
        Base::A2c(a2c) => (a2c.bootstrap_truncation, a2c.vf_coef) = (false, HALF * a2c.vf_coef),
        Base::Ppo(ppo) => {
            (ppo.bootstrap_truncation, ppo.vf_coef, ppo.n_epochs) = (false, HALF * ppo.vf_coef, 10);
            // A rollout of one environment has fewer steps than a rollout with the preset "perturb": an eighth with PPO
            // FF, a sixteenth with PPO RC and RL²-PPO. With this interval, a line of the log covers a similar number of
            // steps. Nothing else depends on this setting.
            common.log_interval = if let Wrapper::Epopt(_) = settings.wrapper { 1 } else { 10 };
        }
        Base::Random | Base::Heuristic => {}
    }
    if let Wrapper::Epopt(epopt) = &mut settings.wrapper {
        epopt.rank_by = Ranking::Normalized;
        epopt.update_per_episode = common.architecture == Architecture::Rc;
    }
}

/// Factor for the weight of the value loss. The code of Packer et al. (2018) uses half of the squared error as the
/// value loss; perturb uses the whole squared error.
const HALF: f64 = 0.5;

/// Removes the settings that earlier versions of the program did not have, if they are set to the behaviour of those
/// versions. The names of an experiment's trainings are derived from the remaining settings, so results of earlier
/// versions are still found by name.
pub(super) fn leave_out_younger(table: &mut Table) {
    let is_older = |key: &str, value: &toml::Value| match key {
        "preset" => value.as_str() == Some("perturb"),
        "reward_return_runs_on" | "update_per_episode" => value.as_bool() == Some(false),
        "rank_by" => value.as_str() == Some("raw"),
        _ => false,
    };
    table.retain(|key, value| !is_older(key, value));
}
