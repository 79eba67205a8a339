//! The amount of experience to collect between two updates, and how much of it is still missing.

/// The amount of experience that a learner collects between two updates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CollectUntil {
    /// T steps of each environment. An episode may continue in the next rollout.
    Steps(usize),
    /// L complete episodes, counted over all environments. The environments are reset first, and each episode draws new
    /// parameters.
    Episodes(usize),
}

/// The part of a [`CollectUntil`] that is not yet collected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RemainingRollout {
    /// The number of steps still to play in each environment.
    Steps(usize),
    /// The number of complete episodes still to play, for each environment.
    Episodes(EpisodeQuotas),
}

/// The number of episodes that each environment still has to play.
///
/// The L episodes are divided among the environments in advance, as evenly as possible. Taking the first L episodes to
/// end would favour short episodes. An environment that has played all its episodes is still stepped with the batch,
/// but its further steps are not stored and do not enter statistics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EpisodeQuotas {
    /// `[N]` episodes left to play.
    left: Vec<usize>,
    /// `[N]` whether the environment's next step is collected.
    active: Vec<bool>,
    /// `[N]` whether the environment's last step was collected.
    stepped: Vec<bool>,
}

impl CollectUntil {
    /// Starts counting in N = `n_envs` environments.
    pub fn begin(self, n_envs: usize) -> RemainingRollout {
        let count = match self {
            Self::Steps(count) => return RemainingRollout::Steps(count),
            Self::Episodes(count) => count,
        };
        let left: Vec<usize> = (0..n_envs).map(|i| count / n_envs + usize::from(i < count % n_envs)).collect();
        let active: Vec<bool> = left.iter().map(|&left| left > 0).collect();
        RemainingRollout::Episodes(EpisodeQuotas { left, stepped: active.clone(), active })
    }
}

impl RemainingRollout {
    /// Returns whether everything is collected.
    pub fn is_done(&self) -> bool {
        match self {
            Self::Steps(left) => *left == 0,
            Self::Episodes(quotas) => !quotas.active.contains(&true),
        }
    }

    /// Counts one step of all environments. `ended` lists the environments (0 … N-1) whose episodes ended with it.
    pub fn advance(&mut self, ended: impl Iterator<Item = usize>) {
        match self {
            Self::Steps(left) => *left = left.saturating_sub(1),
            Self::Episodes(EpisodeQuotas { left, active, stepped }) => {
                stepped.copy_from_slice(active);
                for slot in ended.filter(|&slot| stepped[slot]) {
                    left[slot] -= 1;
                    active[slot] = left[slot] > 0;
                }
            }
        }
    }

    /// Returns, for each environment `[N]`, whether its last step was collected. `None` means all of them.
    pub fn stepped(&self) -> Option<&[bool]> {
        if let Self::Episodes(quotas) = self { Some(&quotas.stepped) } else { None }
    }

    /// Returns, for each environment `[N]`, whether its next step will be collected. `None` means all of them. After an
    /// environment's last episode, the first observation of its next episode is not part of the rollout.
    pub fn active(&self) -> Option<&[bool]> {
        if let Self::Episodes(quotas) = self { Some(&quotas.active) } else { None }
    }

    /// Returns whether the episode that ended with the last step in environment `slot` is part of the rollout.
    pub fn counts(&self, slot: usize) -> bool {
        self.stepped().is_none_or(|stepped| stepped[slot])
    }
}
