//! What is played between two updates.

/// So many steps of every environment, or so many complete episodes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Task {
    /// Episodes run on from one rollout to the next.
    Steps {
        /// T, of which so many are left.
        left: usize,
    },
    /// Each environment plays its share of complete episodes from a reset on.
    Episodes(Dues),
}

/// How many episodes of each environment are still due.
///
/// They are fixed beforehand, as evenly as possible: to take the first to end instead would favour short ones. An
/// environment that has done its part goes on unseen, neither stored as an episode nor part of any statistics.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Dues {
    /// `[N]`
    left: Vec<usize>,
    /// `[N]` where the next step counts.
    active: Vec<bool>,
    /// `[N]` where the last step counted.
    stepped: Vec<bool>,
}

impl Task {
    /// `count` steps of every environment.
    pub fn steps(count: usize) -> Self {
        Self::Steps { left: count }
    }

    /// `count` complete episodes in N = `n_envs` environments, all of which are reset before.
    pub fn episodes(count: usize, n_envs: usize) -> Self {
        let left: Vec<usize> = (0..n_envs).map(|i| count / n_envs + usize::from(i < count % n_envs)).collect();
        let active: Vec<bool> = left.iter().map(|&left| left > 0).collect();
        Self::Episodes(Dues { left, stepped: active.clone(), active })
    }

    /// Whether nothing is left to play.
    pub fn is_done(&self) -> bool {
        match self {
            Self::Steps { left } => *left == 0,
            Self::Episodes(dues) => !dues.active.contains(&true),
        }
    }

    /// A step was made in all environments, which ended the episodes of the `ended` slots.
    pub fn advance(&mut self, ended: impl Iterator<Item = usize>) {
        match self {
            Self::Steps { left } => *left = left.saturating_sub(1),
            Self::Episodes(Dues { left, active, stepped }) => {
                stepped.copy_from_slice(active);
                for slot in ended.filter(|&slot| stepped[slot]) {
                    left[slot] -= 1;
                    active[slot] = left[slot] > 0;
                }
            }
        }
    }

    /// `[N]` where the last step counted; all if `None`.
    pub fn stepped(&self) -> Option<&[bool]> {
        if let Self::Episodes(dues) = self { Some(&dues.stepped) } else { None }
    }

    /// `[N]` where the next step will count; all if `None`. What is observed after an environment's last episode begins
    /// one that is not seen.
    pub fn active(&self) -> Option<&[bool]> {
        if let Self::Episodes(dues) = self { Some(&dues.active) } else { None }
    }

    /// Whether an episode that the last step ended in `slot` is one of those that were to be played.
    pub fn counts(&self, slot: usize) -> bool {
        self.stepped().is_none_or(|stepped| stepped[slot])
    }
}
