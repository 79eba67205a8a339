//! The part of a run that does not depend on how rollouts are collected: policy, algorithm, counters, logs and
//! checkpoints.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use perturb_checkpoint::Counters;
use perturb_files::interrupt::StopFlag;
use perturb_policy::{CollectUntil, Normalisers, Player, PlayerTrainingState, PolicySpec};
use perturb_records::ParameterComparison;
use perturb_settings::{Common, EpoptConfig, TrainConfig, Wrapper};

use super::ending::{RECENT, is_over};
use super::{LONG_UPDATE, LastCheckpoint, Result, RunDirectory, TrainError, TrainOutcome};
use crate::algorithm::{Algorithm, UpdateStats};
use crate::checkpoint::{Checkpoint, History, ResumeState, State};
use crate::client::EndedEpisode;
use crate::error::Error;
use crate::logging::{Clock, EpisodeFigures, Logs, Progress, TimeShares};
use crate::policy::{GradientWorkspace, TrainablePolicy};
use crate::rollout::{CollectorState, RolloutBuffer};

/// Holds the policy, algorithm, rollout, logs and checkpoint of a run.
pub(super) struct Trainer<'a> {
    pub(super) directory: &'a RunDirectory,
    pub(super) policy: TrainablePolicy,
    pub(super) algorithm: Box<dyn Algorithm>,
    pub(super) rollout: RolloutBuffer,
    pub(super) tally: EpisodeTally,
    pub(super) logs: Logs,
    /// The checkpoint after the last complete iteration. Its weights and normalisers are updated only when it is saved.
    pub(super) checkpoint: Checkpoint,
    pub(super) clock: Clock,
    /// Seconds spent on each activity, including the time before the training was resumed.
    pub(super) shares: TimeShares,
    /// Duration of the last update; `None` before the first.
    pub(super) last_update: Option<Duration>,
    /// Counters of the last checkpoint on disk; `None` before the first.
    pub(super) saved: Option<Counters>,
    /// Remaining marks, ascending: numbers of episodes after which the intermediate policy is saved.
    pub(super) marks: VecDeque<u64>,
}

/// Collects the episodes that end while a rollout is collected.
pub(super) struct EpisodeTally {
    /// Compares the requested parameters of episodes with the parameters applied by the physics.
    pub(super) comparison: ParameterComparison,
    /// Figures of the last episodes, at most [`RECENT`], oldest first.
    pub(super) recent: VecDeque<EpisodeFigures>,
    /// Ended episodes that have not been written to the log yet.
    pub(super) ended: Vec<EndedEpisode>,
}

/// Decisions after an iteration: what to save, and whether the run ends.
pub(super) struct IterationOutcome {
    progress: Progress,
    /// Whether a checkpoint is due.
    pub(super) save: bool,
    /// The marks that this iteration has reached.
    pub(super) marks: Vec<u64>,
    /// Whether the run ends: it has reached its budget or its success rate, or there was a signal.
    pub(super) ends: bool,
    signal: Option<i32>,
    logged: bool,
}

impl Trainer<'_> {
    /// Returns the policy's shape.
    pub(super) fn spec(&self) -> &PolicySpec {
        self.policy.spec()
    }

    /// Returns the amount of experience to collect between two updates.
    pub(super) fn collect_until(&self) -> CollectUntil {
        self.algorithm.collect_until()
    }

    /// Returns the policy's weights `[P]`.
    pub(super) fn weights(&self) -> &[f32] {
        self.policy.flat_weights()
    }

    /// Returns the buffers for a rollout and its episodes.
    pub(super) fn collecting(&mut self) -> (&mut RolloutBuffer, &mut EpisodeTally) {
        (&mut self.rollout, &mut self.tally)
    }

    /// Returns the duration of the last update, or [`LONG_UPDATE`] before the first.
    ///
    /// This duration predicts the next update. It decides whether a thread keeps connections alive during that update.
    /// For the shortest updates, the thread would cost more than the update itself. With EPOpt, the next update can
    /// take some ten times as long as predicted. Even then, an update with a prediction below [`LONG_UPDATE`] ends
    /// before a server drops the connection.
    pub(super) fn last_update(&self) -> Duration {
        self.last_update.unwrap_or(LONG_UPDATE)
    }

    /// Returns a workspace for [`Trainer::update`], see [`TrainablePolicy::workspace`].
    pub(super) fn workspace(&self) -> Result<Option<GradientWorkspace>> {
        Ok(self.policy.workspace()?)
    }

    /// Updates the policy from the collected rollout. `acting` and `waiting` are the times that collecting took.
    /// Gradients are computed in `workspace` if it is given. Loads the new weights into `player`, which is given if
    /// actions are chosen in this process.
    ///
    /// # Errors
    /// An error if a number is not finite, if an episode ran with other parameters than requested, or if a log cannot
    /// be written.
    pub(super) fn update(
        &mut self,
        player: Option<&mut Player>,
        workspace: Option<&mut GradientWorkspace>,
        acting: Duration,
        waiting: Duration,
    ) -> Result<Progress> {
        let Some(workspace) = workspace else { return self.update_policy(player, acting, waiting) };
        self.policy.swap_workspace(workspace);
        let progress = self.update_policy(player, acting, waiting);
        self.policy.swap_workspace(workspace);
        progress
    }

    /// Updates the policy with its current gradient workspace, see [`Trainer::update`].
    fn update_policy(
        &mut self,
        mut player: Option<&mut Player>,
        acting: Duration,
        waiting: Duration,
    ) -> Result<Progress> {
        let (ended, steps) = self.log_episodes()?;
        let start = Instant::now();
        if let Some(player) = player.as_deref_mut() {
            self.policy.reuse_activations(player);
        }
        let remaining = self.progress_remaining();
        let update =
            self.algorithm.update(&mut self.policy, &self.rollout, remaining).map_err(|error| match error {
                Error::Stopped { signal } => TrainError::UpdateStopped { signal },
                error => error.into(),
            })?;
        if let Some(player) = player {
            // Loading is fast here, because the update has left the weights in the processor's caches.
            player.load(self.policy.flat_weights()).map_err(Error::from)?;
        }
        let elapsed = start.elapsed();
        self.last_update = Some(elapsed);
        self.shares.acting += acting.as_secs_f64();
        self.shares.waiting += waiting.as_secs_f64();
        self.shares.updating += elapsed.as_secs_f64();

        // EPOpt's selection decides which episodes and steps count as learned.
        let (learned_episodes, learned_steps) = match update.selection {
            Some(selection) => (selection.kept, selection.kept_steps),
            None => (ended, steps),
        };
        let counters = &mut self.checkpoint.state.counters;
        counters.iterations += 1;
        counters.timesteps += steps;
        counters.episodes += learned_episodes;
        counters.generated_episodes += ended;
        counters.learned_timesteps += learned_steps;
        Ok(self.progress(update))
    }

    /// Logs the episodes of the rollout. Returns the number of episodes and the number of steps that the rollout adds
    /// to the counters.
    fn log_episodes(&mut self) -> Result<(u64, u64)> {
        let EpisodeTally { comparison, ended, .. } = &mut self.tally;
        for episode in &*ended {
            self.logs.episode(episode)?;
        }
        if let Some(error) = ended.iter().find_map(|episode| difference(comparison, episode)) {
            return Err(error);
        }
        let steps = match self.algorithm.collect_until() {
            CollectUntil::Steps(_) => (self.rollout.n_steps() * self.rollout.n_envs()) as u64,
            CollectUntil::Episodes(_) => ended.iter().map(|episode| u64::from(episode.length)).sum(),
        };
        let count = ended.len() as u64;
        ended.clear();
        Ok((count, steps))
    }

    /// Returns the remaining share of the training, which falls from 1 to 0. It reaches 0 when the policy has learned
    /// from the maximum number of steps: the budget's episodes times the step limit. With EPOpt's `update_per_episode`,
    /// every episode counts as if it had as many steps as the step limit, because the paper's published code pads
    /// episodes to this length.
    fn progress_remaining(&self) -> f64 {
        let State { config, environment_spec, counters, .. } = &self.checkpoint.state;
        if let Wrapper::Epopt(EpoptConfig { update_per_episode: true, .. }) = config.settings.wrapper {
            return (1.0 - counters.episodes as f64 / config.common.episodes as f64).max(0.0);
        }
        let most = config.common.episodes as f64 * f64::from(environment_spec.step_limit);
        (1.0 - counters.learned_timesteps as f64 / most).max(0.0)
    }

    /// Logs the iteration if a log line is due. Decides whether to save a checkpoint or intermediate policies, and
    /// whether the run ends.
    ///
    /// # Errors
    /// An error if a log cannot be written.
    pub(super) fn finish_iteration(&mut self, progress: Progress, stop: &StopFlag) -> Result<IterationOutcome> {
        let State { config: TrainConfig { common, .. }, counters, .. } = &self.checkpoint.state;
        let Common { log_interval, checkpoint_interval, .. } = *common;
        let finished = is_over(common, counters, self.tally.recent.iter());
        let signal = stop.signal().filter(|_| !finished);
        let logged = finished || progress.iterations.is_multiple_of(log_interval);
        if logged {
            self.logs.progress(&progress)?;
        }
        let due = |saved: Counters| progress.episodes / checkpoint_interval > saved.episodes / checkpoint_interval;
        let save = finished || self.saved.is_none_or(due) || signal.is_some();
        let passed = |mark: &u64| finished || *mark <= progress.episodes; // the final policy also serves for marks beyond the end
        let passed = self.marks.partition_point(passed);
        let marks = self.marks.drain(..passed).collect();
        Ok(IterationOutcome { progress, save, marks, ends: finished || signal.is_some(), signal, logged })
    }

    /// Copies the current weights and `normalisers` into the checkpoint.
    fn copy_policy(&mut self, normalisers: Normalisers) {
        let Self { policy, checkpoint, .. } = self;
        policy.copy_weights(&mut checkpoint.weights);
        checkpoint.state.observation_normaliser = normalisers.observations;
        checkpoint.state.reward_normaliser = normalisers.rewards;
    }

    /// Saves the current policy for the marks that this iteration has reached. Must be called before the next
    /// checkpoint is saved, because a run that resumes from that checkpoint does not reach these marks again.
    ///
    /// # Errors
    /// An error if a file cannot be written.
    pub(super) fn keep(&mut self, iteration: &IterationOutcome, normalisers: &Normalisers) -> Result<()> {
        if !iteration.marks.is_empty() {
            self.copy_policy(normalisers.clone());
        }
        iteration.marks.iter().try_for_each(|&mark| Ok(self.checkpoint.save(&self.directory.mark(mark), None)?))
    }

    /// Replaces the checkpoint on disk. `snapshots`, `player` and `normalisers` must be from after the last iteration.
    ///
    /// # Errors
    /// An error if a file cannot be written. An earlier checkpoint is then kept.
    pub(super) fn save(
        &mut self,
        snapshots: Vec<bytes::Bytes>,
        player: PlayerTrainingState,
        normalisers: Normalisers,
    ) -> Result<()> {
        self.copy_policy(normalisers);
        // The logs must be on the disk before the checkpoint that refers to them.
        let history = History {
            logs: self.logs.sync()?,
            recent: self.tally.recent.iter().copied().collect(),
            elapsed: self.clock.elapsed(),
            shares: self.shares,
        };
        let collector = CollectorState { snapshots, player };
        let state = ResumeState { collector, algorithm: self.algorithm.state(), history };
        state.save(&self.checkpoint, &self.directory.checkpoint())?;
        self.saved = Some(self.checkpoint.state.counters);
        Ok(())
    }

    /// Returns the outcome of the run. Must be called after the last iteration was saved.
    ///
    /// # Errors
    /// An error if a log cannot be written.
    pub(super) fn end(&mut self, iteration: &IterationOutcome) -> Result<TrainOutcome> {
        if !iteration.logged {
            self.logs.progress(&iteration.progress)?; // this line comes after the checkpoint, so a resumed run deletes it
        }
        Ok(TrainOutcome { checkpoint: self.checkpoint.clone(), progress: iteration.progress, signal: iteration.signal })
    }

    /// Wraps the `error` that ended the run, together with the last checkpoint on disk, if there is one.
    pub(super) fn failed(&self, error: TrainError) -> TrainError {
        let run = || self.directory.path().to_owned();
        let last = self.saved.map(|Counters { episodes, .. }| LastCheckpoint { episodes, run: run() });
        TrainError::Failed { last, source: Box::new(error) }
    }

    /// Returns the progress after an update.
    fn progress(&self, update: UpdateStats) -> Progress {
        let Counters { iterations, timesteps, episodes, generated_episodes, .. } = self.checkpoint.state.counters;
        Progress {
            iterations,
            timesteps,
            elapsed: self.clock.elapsed(),
            shares: self.shares,
            episodes,
            generated_episodes,
            saved_timesteps: self.saved.map_or(0, |saved| saved.timesteps),
            recent: EpisodeFigures::mean(self.tally.recent.iter()),
            update,
        }
    }
}

impl EpisodeTally {
    /// Adds an episode that ended.
    pub(super) fn note(&mut self, episode: &EndedEpisode) {
        while self.recent.len() >= RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(episode.into());
        self.ended.push(episode.clone());
    }
}

/// Returns the error for an episode that ran with other parameters than requested; `None` if they agree up to rounding.
fn difference(comparison: &mut ParameterComparison, episode: &EndedEpisode) -> Option<TrainError> {
    let receipt = &episode.receipt;
    let difference = comparison.difference_beyond_rounding(&receipt.requested, &receipt.applied)?;
    let EndedEpisode { environment_index, episode_index, .. } = *episode;
    Some(TrainError::NotApplied { environment_index, episode_index, difference })
}
