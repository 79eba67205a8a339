//! Options of sessions: the environments to open, where actions are chosen, and how long to wait for lost servers.

use std::ops::Range;
use std::time::Duration;

use perturb_protocol::{Version, proto};
use perturb_settings::Observe;
use perturb_settings::sets::{Context, Parameters};

use crate::proto::AutoresetMode;

/// Describes the environments of one training or test.
#[derive(Clone, Debug)]
pub struct OpenOptions {
    /// The environment's name in the catalogue.
    pub environment: String,
    /// The version whose distributions the parameters are drawn from.
    pub version: Version,
    /// Distributions that replace the version's, by parameter name.
    pub parameters: Parameters,
    /// Contexts, one of which each trial has; all have the same parameters. If empty, trials have no contexts.
    pub contexts: Vec<Context>,
    /// N, the number of environments, at least 1.
    pub num_envs: usize,
    /// The seed of the environments. With the environment's index it determines all their random numbers.
    pub seed: u64,
    /// Number of episodes in a trial. Parameters are drawn once per trial.
    pub episodes_per_trial: u32,
    /// The content of observations: the state, or also the parameters. Must be the same in all options of a session.
    pub observe: Observe,
}

/// The place where the actions of trainings and tests are chosen. It affects only speed: all results are the same to
/// the byte.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ActorLocation {
    /// The server chooses the actions, if it supports this. The network's latency then occurs once per rollout, not at
    /// each step. Some trainings always choose actions in the client: trainings over several servers, groups of
    /// trainings with [short](perturb_settings::CollectionMode) rollouts, and trainings with observation noise.
    #[default]
    Server,
    /// The client chooses the actions.
    Client,
}

/// Settings for waiting for lost servers.
#[derive(Clone, Copy, Debug)]
pub struct ServerWait {
    /// Maximum time to wait without progress of the run; zero for no waiting.
    pub limit: Duration,
    /// Receives a sentence for the user at the start of each wait.
    pub tell: fn(&str),
}

impl Default for ServerWait {
    fn default() -> Self {
        Self { limit: Duration::ZERO, tell: |_| {} }
    }
}

/// Returns the request that opens the slots of `range`. Slots are numbered over all `options` together. Slots of a
/// single option are requested in the form that older servers also understand. `lease` is the protocol's field: the
/// maximum number of unanswered requests of a leased session, or 0. Returns `None` if an index exceeds the protocol's
/// 32 bits.
pub(super) fn open_request(
    options: &[OpenOptions],
    range: Range<usize>,
    autoreset_mode: AutoresetMode,
    lease: u32,
) -> Option<proto::Open> {
    let mut first = 0;
    let mut groups = Vec::new();
    for option in options {
        let start = range.start.max(first);
        let end = range.end.min(first + option.num_envs);
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
        Ok([group]) => proto::Open {
            version: group.version,
            parameters: group.parameters,
            batch_size: group.size,
            seed: group.seed,
            first_environment_index: group.first_environment_index,
            episodes_per_trial: group.episodes_per_trial,
            contexts: group.contexts,
            ..open
        },
    })
}

impl OpenOptions {
    /// Returns the protocol's description of `size` of these environments. `first` is the index of the first of them.
    /// Returns `None` if a number exceeds the protocol's 32 bits.
    fn group(&self, first: usize, size: usize) -> Option<proto::SlotGroup> {
        Some(proto::SlotGroup {
            size: u32::try_from(size).ok()?,
            version: self.version.to_proto().into(),
            parameters: self.parameters.iter().map(|(name, values)| (name.clone(), values.into())).collect(),
            seed: self.seed,
            first_environment_index: u32::try_from(first).ok()?,
            episodes_per_trial: self.episodes_per_trial,
            contexts: self.contexts.first().map(|first| proto::Contexts {
                names: first.keys().cloned().collect(),
                values: self.contexts.iter().flat_map(|context| context.values().copied()).collect(),
            }),
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
            contexts: Vec::new(),
            num_envs,
            seed,
            episodes_per_trial: 1,
            observe: Observe::State,
        }
    }

    #[test]
    fn slots_of_several_options_are_groups() {
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
