//! A shard: the part of a batch that one worker runs at a time.

use super::{
    receipts::ReceiptColumns,
    settings::{Autoreset, BatchSettings, SlotGroupSettings},
    sync::lock,
};
use crate::{
    env::{
        self, Action, ActionSpec, Distribution, Draw, EnvironmentSpec, EpisodeSettings, Episodes, FinishedEpisode,
        StartedEpisode,
    },
    scene::Scene,
};
use bytes::Bytes;
use std::sync::{Arc, Mutex};

/// A command for a shard. The slots in a command are relative to the shard's first slot.
pub(super) enum Command {
    Open,
    Step,
    Reset(Vec<SlotReset>),
    /// Begins the next episode in every environment of the shard.
    ResetAll,
    Snapshot(Vec<usize>),
    /// Restores these snapshots, each in its slot. Keeps the previous states for [`Command::RollBack`].
    Restore(Vec<(usize, Bytes)>),
    /// Undoes the last restore.
    RollBack,
}

/// The reset of one environment.
pub(super) struct SlotReset {
    pub(super) slot: usize,
    pub(super) seed: Option<u64>,
    pub(super) distributions: Option<Arc<[Distribution]>>,
    pub(super) state: Option<Vec<f64>>,
}

impl SlotReset {
    /// Makes a reset that begins the next episode of the current trial.
    pub(super) fn next_episode(slot: usize) -> Self {
        Self { slot, seed: None, distributions: None, state: None }
    }
}

/// The environments of `n` successive slots, with the inputs and outputs of their steps.
pub(super) struct Shard {
    pub(super) first_slot: usize,
    pub(super) size: usize,
    spec: &'static EnvironmentSpec,
    /// The groups of slots whose environments [`Command::Open`] creates.
    groups: Vec<SlotGroupSettings>,
    autoreset: Autoreset,
    receipts: bool,
    receipt_arrays: bool,
    observe_parameters: bool,
    /// O, the number of entries of an observation.
    observation_size: usize,
    pub(super) command: Command,
    slots: Vec<Episodes>,
    backups: Vec<(usize, Vec<u8>)>,
    /// The actions in a discrete space, `[n]`, valid choices.
    pub(super) choices: Vec<u32>,
    /// The actions in a continuous space, `[n, A]`, finite.
    pub(super) vectors: Vec<f32>,
    /// The current observations, `[n, O]`.
    pub(super) observations: Vec<f32>,
    /// The rewards of the last step, `[n]`.
    pub(super) rewards: Vec<f32>,
    /// 1 where the task ended the episode in the last step, `[n]`.
    pub(super) terminated: Vec<u8>,
    /// 1 where the step limit ended the episode in the last step, `[n]`.
    pub(super) truncated: Vec<u8>,
    /// The terms of the rewards of the last step, `[n, terms]`.
    pub(super) reward_terms: Vec<f32>,
    /// The last observations of the episodes in `ended`, `[k, O]`.
    pub(super) final_observations: Vec<f32>,
    /// The episodes that ended in the last command, `[k]`, each with its slot in the batch.
    pub(super) ended: Vec<(u32, FinishedEpisode)>,
    /// The episodes that began in the last command, each with its slot in the batch. Empty without receipts, and also
    /// after a step if receipts are arrays.
    pub(super) started: Vec<(u32, StartedEpisode)>,
    /// The receipts of the episodes in `ended`, if receipts are arrays.
    pub(super) ended_receipts: ReceiptColumns,
    /// The receipts of the episodes that began in the last step, if receipts are arrays.
    pub(super) started_receipts: ReceiptColumns,
    pub(super) snapshots: Vec<Vec<u8>>,
    pub(super) failure: Option<env::Error>,
    terms: Vec<f64>,
}

impl Shard {
    /// Makes a shard for the slots of `groups`. `first_slot` is its first slot in the batch. [`Command::Open`] creates
    /// the environments later.
    pub(super) fn new(settings: &BatchSettings, groups: Vec<SlotGroupSettings>, first_slot: usize) -> Self {
        let size = groups.iter().map(|group| group.size).sum();
        Self { groups, command: Command::Open, ..Self::with_environments(settings, Vec::new(), (first_slot, size)) }
    }

    /// Makes a shard of `size` slots from `first_slot` on, with existing environments. Its observations are valid at
    /// once, its other outputs only after the next step.
    pub(super) fn with_environments(
        settings: &BatchSettings,
        slots: Vec<Episodes>,
        (first_slot, size): (usize, usize),
    ) -> Self {
        let BatchSettings { spec, autoreset, receipts, receipt_arrays, observe_parameters, .. } = *settings;
        let observation_size = settings.observation_size();
        let (choices, vectors) = match spec.action {
            ActionSpec::Discrete(_) => (size, 0),
            ActionSpec::Continuous(channels) => (0, size * channels.len()),
        };
        let mut shard = Self {
            first_slot,
            size,
            spec,
            groups: Vec::new(),
            autoreset,
            receipts,
            receipt_arrays,
            observe_parameters,
            observation_size,
            command: Command::Step,
            slots,
            backups: Vec::new(),
            choices: vec![0; choices],
            vectors: vec![0.0; vectors],
            observations: vec![0.0; size * observation_size],
            rewards: vec![0.0; size],
            terminated: vec![0; size],
            truncated: vec![0; size],
            reward_terms: vec![0.0; size * spec.reward_terms.len()],
            final_observations: Vec::new(),
            ended: Vec::new(),
            started: Vec::new(),
            ended_receipts: ReceiptColumns::default(),
            started_receipts: ReceiptColumns::default(),
            snapshots: Vec::new(),
            failure: None,
            terms: vec![0.0; spec.reward_terms.len()],
        };
        (0..shard.slots.len()).for_each(|slot| shard.observe(slot));
        shard
    }

    /// Removes the environments from the shard and returns them.
    pub(super) fn take_slots(&mut self) -> Vec<Episodes> {
        std::mem::take(&mut self.slots)
    }

    /// The environment index and the current trial index of each environment.
    pub(super) fn trials(&self) -> impl Iterator<Item = (u32, u64)> {
        self.slots.iter().map(|episodes| (episodes.id().environment_index, episodes.id().trial_index))
    }

    /// The slots of this shard whose episodes have ended. The slots count from the first slot of the batch.
    pub(super) fn ended_slots(&self) -> impl Iterator<Item = usize> {
        let ended = self.slots.iter().enumerate().filter(|(_, episodes)| episodes.ended());
        ended.map(|(slot, _)| self.first_slot + slot)
    }

    /// The current distributions of the environment in a slot. `slot` counts from the first slot of the batch.
    pub(super) fn distributions(&self, slot: usize) -> Arc<[Distribution]> {
        Arc::clone(&self.slots[slot - self.first_slot].settings().distributions)
    }

    /// The address of the current episode in a slot: seed, environment index and episode index. `slot` counts from the
    /// first slot of the batch.
    pub(super) fn draw(&self, slot: usize) -> Draw {
        self.slots[slot - self.first_slot].draw()
    }

    /// The address of each environment's current episode: seed, environment index and episode index.
    pub(super) fn draws(&self) -> impl Iterator<Item = Draw> {
        self.slots.iter().map(Episodes::draw)
    }

    /// Has every environment draw random numbers of its next step before its action is known.
    pub(super) fn draw_ahead(&mut self) {
        self.slots.iter_mut().for_each(Episodes::draw_ahead);
    }

    /// The scene to draw of the environment in a slot. `slot` counts from the first slot of the batch.
    pub(super) fn scene(&self, slot: usize) -> Option<Scene> {
        self.slots[slot - self.first_slot].scene()
    }

    /// An upper bound of the length of the first environment's snapshot, without its distributions, bytes.
    pub(super) fn max_snapshot_bytes(&self) -> usize {
        self.slots.first().map_or(0, Episodes::max_snapshot_bytes)
    }

    /// Carries out the command. Returns the number of environments that took a step, and the number of episodes that
    /// ended.
    pub(super) fn run(&mut self) -> (usize, usize) {
        self.ended.clear();
        self.started.clear();
        self.ended_receipts.clear();
        self.started_receipts.clear();
        self.final_observations.clear();
        self.snapshots.clear();
        self.failure = None;
        let mut steps = 0;
        match std::mem::replace(&mut self.command, Command::Step) {
            Command::Step => steps = self.step(),
            Command::Open => self.open(),
            Command::Reset(resets) => resets.iter().for_each(|reset| self.reset(reset)),
            Command::ResetAll => (0..self.size).for_each(|slot| self.reset(&SlotReset::next_episode(slot))),
            Command::Snapshot(slots) => self.snapshots.extend(slots.iter().map(|&slot| self.slots[slot].snapshot())),
            Command::Restore(entries) => self.restore(&entries),
            Command::RollBack => self.roll_back(),
        }
        (steps, self.ended.len())
    }

    fn open(&mut self) {
        for group in std::mem::take(&mut self.groups) {
            for i in 0..group.size {
                match (self.spec.make)() {
                    Ok(environment) => {
                        // The sum cannot overflow, because the group's last index was checked when the batch was
                        // opened.
                        let environment_index = group.episodes.environment_index + i as u32;
                        let settings = EpisodeSettings { environment_index, ..group.episodes.clone() };
                        let episodes = Episodes::new(environment, settings);
                        let seen = self.observe_parameters;
                        self.slots.push(if seen { episodes.observing_parameters() } else { episodes });
                    }
                    Err(error) => {
                        self.failure = Some(error);
                        return;
                    }
                }
                let slot = self.slots.len() - 1;
                self.note_start(slot);
                self.observe(slot);
            }
        }
    }

    /// Advances every environment. An environment whose episode had ended begins an episode instead. Returns the number
    /// of environments that took a step.
    fn step(&mut self) -> usize {
        let (n_terms, mut steps) = (self.terms.len(), 0);
        for slot in 0..self.size {
            let episodes = &mut self.slots[slot];
            if episodes.ended() {
                // Only the autoreset mode next-step gets here with an ended episode. In same-step mode, no ended
                // episode remains after a step, and none can be restored. In disabled mode, the step was refused.
                episodes.begin(None);
                self.rewards[slot] = 0.0;
                self.terminated[slot] = 0;
                self.truncated[slot] = 0;
                self.reward_terms[slot * n_terms..][..n_terms].fill(0.0);
                self.note_start_in_step(slot);
                self.observe(slot);
                continue;
            }
            let action = match self.spec.action {
                ActionSpec::Discrete(_) => Action::Discrete(self.choices[slot]),
                ActionSpec::Continuous(a) => Action::Continuous(&self.vectors[slot * a.len()..][..a.len()]),
            };
            let outcome = episodes.step(action, &mut self.terms);
            steps += 1;
            self.rewards[slot] = outcome.reward as f32;
            self.terminated[slot] = outcome.terminated.into();
            self.truncated[slot] = outcome.truncated.into();
            for (out, term) in self.reward_terms[slot * n_terms..][..n_terms].iter_mut().zip(&self.terms) {
                *out = *term as f32;
            }
            self.observe(slot);
            if outcome.terminated || outcome.truncated {
                self.finish(slot);
            }
        }
        steps
    }

    fn finish(&mut self, slot: usize) {
        let n = self.observation_size;
        self.final_observations.extend_from_slice(&self.observations[slot * n..][..n]);
        let as_message = self.receipts && !self.receipt_arrays;
        self.ended.push(((self.first_slot + slot) as u32, self.slots[slot].finished(as_message)));
        if self.receipts && self.receipt_arrays {
            self.ended_receipts.push(self.first_slot + slot, &self.slots[slot]);
        }
        if self.autoreset == Autoreset::SameStep {
            self.slots[slot].begin(None);
            self.note_start_in_step(slot);
            self.observe(slot);
        }
    }

    fn reset(&mut self, reset: &SlotReset) {
        let episodes = &mut self.slots[reset.slot];
        if reset.seed.is_some() || reset.distributions.is_some() {
            episodes.begin_trial(reset.seed, reset.distributions.clone(), reset.state.as_deref());
        } else {
            episodes.begin(reset.state.as_deref());
        }
        self.note_start(reset.slot);
        self.observe(reset.slot);
    }

    fn restore(&mut self, entries: &[(usize, Bytes)]) {
        self.backups.clear();
        for (slot, snapshot) in entries {
            self.backups.push((*slot, self.slots[*slot].snapshot()));
            let restored = self.slots[*slot].restore(snapshot);
            let ended = self.autoreset == Autoreset::SameStep && self.slots[*slot].ended();
            let refused = || env::Error::Snapshot {
                reason: "its episode has ended, which a session in same-step mode cannot hold".into(),
            };
            if let Err(error) = restored.and_then(|()| if ended { Err(refused()) } else { Ok(()) }) {
                self.failure = Some(error);
                return;
            }
            self.observe(*slot);
        }
    }

    fn roll_back(&mut self) {
        for (slot, snapshot) in std::mem::take(&mut self.backups) {
            self.failure = self.slots[slot].restore(&snapshot).err();
            self.observe(slot);
        }
    }

    fn note_start_in_step(&mut self, slot: usize) {
        if self.receipts && self.receipt_arrays {
            self.started_receipts.push(self.first_slot + slot, &self.slots[slot]);
        } else {
            self.note_start(slot);
        }
    }

    fn note_start(&mut self, slot: usize) {
        // Starts of episodes are reported only with receipts, because each start costs a message. Clients without
        // receipts count episodes themselves.
        if self.receipts {
            self.started.push(((self.first_slot + slot) as u32, self.slots[slot].started(true)));
        }
    }

    fn observe(&mut self, slot: usize) {
        let n = self.observation_size;
        self.slots[slot].observe(&mut self.observations[slot * n..][..n]);
    }
}

/// Gives every shard its part of a batch's actions, little-endian i32 `[N]` or f32 `[N, A]`.
pub(super) fn set_actions(shards: &[Mutex<Shard>], actions: &[u8]) {
    let mut words = actions.as_chunks::<4>().0.iter();
    for shard in shards {
        let mut shard = lock(shard);
        let Shard { choices, vectors, .. } = &mut *shard;
        // Either `choices` or `vectors` is empty. `words` must be the second argument of `zip`. If it were the first,
        // `zip` would consume a word that belongs to the next shard.
        choices.iter_mut().zip(&mut words).for_each(|(to, from)| *to = u32::from_le_bytes(*from));
        vectors.iter_mut().zip(&mut words).for_each(|(to, from)| *to = f32::from_le_bytes(*from));
    }
}
