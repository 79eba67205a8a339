//! The amount of experience between two updates, and the part that is still to be collected.

/// The amount of experience that a learner collects between two updates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CollectUntil {
    /// T steps of each environment. Episodes continue from one rollout to the next.
    Steps(usize),
    /// L complete episodes in all environments together, each in a freshly drawn environment. All environments are reset
    /// first.
    Episodes(usize),
}

/// The part of a [`CollectUntil`] that is still to be played.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RemainingRollout {
    /// Steps of each environment.
    Steps(usize),
    /// Complete episodes of each environment.
    Episodes(EpisodeQuotas),
}

/// Number of episodes that each environment still has to play.
///
/// The quotas are fixed beforehand, as evenly as possible. The first L episodes to end would be biased towards short ones.
/// An environment that has met its quota is stepped on, but its steps are neither stored as episodes nor part of any
/// statistics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EpisodeQuotas {
    /// `[N]`
    left: Vec<usize>,
    /// `[N]` whether the next step counts.
    active: Vec<bool>,
    /// `[N]` whether the last step counted.
    stepped: Vec<bool>,
}

impl CollectUntil {
    /// Starts to count in N = `n_envs` environments.
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
    /// Whether nothing is left to play.
    pub fn is_done(&self) -> bool {
        match self {
            Self::Steps(left) => *left == 0,
            Self::Episodes(quotas) => !quotas.active.contains(&true),
        }
    }

    /// Counts a step of all environments, which ended the episodes of the `ended` slots.
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

    /// `[N]` whether the last step counted; `None` if it counted everywhere.
    pub fn stepped(&self) -> Option<&[bool]> {
        if let Self::Episodes(quotas) = self { Some(&quotas.stepped) } else { None }
    }

    /// `[N]` whether the next step will count; `None` if it will count everywhere. The observation after an environment's
    /// last episode belongs to an episode that is not collected.
    pub fn active(&self) -> Option<&[bool]> {
        if let Self::Episodes(quotas) = self { Some(&quotas.active) } else { None }
    }

    /// Whether an episode that the last step ended in `slot` is one of those to be collected.
    pub fn counts(&self, slot: usize) -> bool {
        self.stepped().is_none_or(|stepped| stepped[slot])
    }
}
