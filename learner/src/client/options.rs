//! What is opened: environments of one or several trainings; where actions are chosen, and how long servers are waited for.

use std::ops::Range;
use std::time::Duration;

use perturb_protocol::{Version, proto};
use perturb_settings::Observe;
use perturb_settings::sets::Parameters;

use crate::proto::AutoresetMode;

/// What to open.
#[derive(Clone, Debug)]
pub struct OpenOptions {
    /// A name from the catalogue.
    pub environment: String,
    /// Where parameters come from.
    pub version: Version,
    /// What replaces the version's distributions of some parameters.
    pub parameters: Parameters,
    /// N, at least 1.
    pub num_envs: usize,
    /// Fixes all randomness of the environments.
    pub seed: u64,
    /// Episodes in a trial.
    pub episodes_per_trial: u32,
    /// What observations have; the same in all options of a session.
    pub observe: Observe,
}

/// Where actions of trainings and tests are chosen, which changes no byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ActAt {
    /// At the server, if it can: a line's delay is then paid once a rollout, not at each step. Trainings over several
    /// servers, several together whose rollouts are [short](perturb_settings::Rollouts), and those that see noise
    /// choose theirs at the client all the same.
    #[default]
    Server,
    /// At the client.
    Client,
}

/// How long lost servers are waited for.
#[derive(Clone, Copy, Debug)]
pub struct ServerWait {
    /// In all, until something is gained; zero does not wait at all.
    pub limit: Duration,
    /// Hears what is waited for, in a sentence.
    pub tell: fn(&str),
}

impl Default for ServerWait {
    fn default() -> Self {
        Self { limit: Duration::ZERO, tell: |_| {} }
    }
}

/// The request for the slots of `range`, counted over all `options`; `None` if an index is beyond what the protocol can
/// number. Slots of one option alone are asked for as servers of every age understand it. `lease` is that of the protocol.
pub(super) fn open_request(
    options: &[OpenOptions],
    range: Range<usize>,
    autoreset_mode: AutoresetMode,
    lease: u32,
) -> Option<proto::Open> {
    let mut first = 0;
    let mut groups = Vec::new();
    for option in options {
        let (start, end) = (range.start.max(first), range.end.min(first + option.num_envs));
        if start < end {
            groups.push(option.group(start - first, end - start)?);
        }
        first += option.num_envs;
    }
    let OpenOptions { environment, observe, .. } = options.first()?;
    let open = proto::Open {
        environment: environment.clone(),
        autoreset_mode: autoreset_mode.into(),
        receipts: true,
        observe_parameters: observe.sees_parameters(),
        lease,
        ..proto::Open::default()
    };
    Some(match <[proto::SlotGroup; 1]>::try_from(groups) {
        Err(groups) => proto::Open { groups, ..open },
        Ok([proto::SlotGroup { size, version, parameters, seed, first_environment_index, episodes_per_trial }]) => {
            let batch_size = size;
            proto::Open { version, parameters, batch_size, seed, first_environment_index, episodes_per_trial, ..open }
        }
    })
}

impl OpenOptions {
    /// `size` slots from `first` on.
    fn group(&self, first: usize, size: usize) -> Option<proto::SlotGroup> {
        Some(proto::SlotGroup {
            size: u32::try_from(size).ok()?,
            version: self.version.to_proto().into(),
            parameters: self.parameters.iter().map(|(name, values)| (name.clone(), values.into())).collect(),
            seed: self.seed,
            first_environment_index: u32::try_from(first).ok()?,
            episodes_per_trial: self.episodes_per_trial,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(num_envs: usize, seed: u64) -> OpenOptions {
        let environment = "CartPole".into();
        OpenOptions {
            environment,
            version: Version::D,
            parameters: Default::default(),
            num_envs,
            seed,
            episodes_per_trial: 1,
            observe: Observe::State,
        }
    }

    #[test]
    fn slots_of_several_options_are_groups_that_count_from_their_own_first() {
        let options = [options(3, 7), options(2, 8)];
        let groups = |range| {
            let open = open_request(&options, range, AutoresetMode::SameStep, 0).unwrap();
            open.groups.iter().map(|g| (g.seed, g.first_environment_index, g.size)).collect::<Vec<_>>()
        };
        assert_eq!(groups(0..5), [(7, 0, 3), (8, 0, 2)]);
        assert_eq!(groups(2..4), [(7, 2, 1), (8, 0, 1)]);
        let alone = open_request(&options, 1..3, AutoresetMode::SameStep, 0).unwrap();
        assert!(alone.groups.is_empty());
        assert_eq!((alone.seed, alone.first_environment_index, alone.batch_size), (7, 1, 2));
    }
}
