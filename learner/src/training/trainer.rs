//! The environment-independent half of a run: policy, algorithm, counters, logs and checkpoints.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use perturb_checkpoint::Counters;
use perturb_files::interrupt::StopFlag;
use perturb_policy::{CollectUntil, Normalisers, Player, PlayerState, PolicySpec};
use perturb_records::ParameterComparison;
use perturb_settings::{Common, EpoptConfig, TrainConfig, Wrapper};

use super::ending::{RECENT, is_over};
use super::{LONG_UPDATE, LastCheckpoint, Result, RunDirectory, TrainError, TrainOutcome};
use crate::algorithm::{Algorithm, UpdateStats};
use crate::checkpoint::{Checkpoint, History, ResumeState, State};
use crate::client::EndedEpisode;
use crate::error::Error;
use crate::logging::{Clock, EpisodeFigures, Logs, Progress, TimeShares};
use crate::policy::{GradientWorkspace, Policy};
use crate::rollout::{CollectorState, Rollout};

/// Owns a run's policy, algorithm, logs and checkpoint.
pub(super) struct Trainer<'a> {
    pub(super) directory: &'a RunDirectory,
    pub(super) policy: Policy,
    pub(super) algorithm: Box<dyn Algorithm>,
    pub(super) rollout: Rollout,
    pub(super) tally: EpisodeTally,
    pub(super) logs: Logs,
    /// The checkpoint after the last whole iteration. Weights and statistics are put in when it is saved.
    pub(super) checkpoint: Checkpoint,
    pub(super) clock: Clock,
    /// Seconds by activity, earlier processes included.
    pub(super) shares: TimeShares,
    /// Duration of the last update.
    pub(super) last_update: Option<Duration>,
    /// Counters of the last checkpoint on disk.
    pub(super) saved: Option<Counters>,
    /// Future numbers of episodes after which the policy is kept for an intermediate evaluation, ascending.
    pub(super) marks: VecDeque<u64>,
}

/// The episodes that ended while a rollout was collected.
pub(super) struct EpisodeTally {
    /// Compares the parameters that episodes ran with to those that were requested.
    pub(super) comparison: ParameterComparison,
    /// The last episodes, at most [`RECENT`].
    pub(super) recent: VecDeque<EpisodeFigures>,
    /// Episodes that are still to be written to the log.
    pub(super) ended: Vec<EndedEpisode>,
}

/// Decisions after an iteration.
pub(super) struct IterationOutcome {
    progress: Progress,
    /// Whether a checkpoint is due.
    pub(super) save: bool,
    /// The marks that were passed.
    pub(super) marks: Vec<u64>,
    /// Whether the run ends: the budget is used up, or a signal came.
    pub(super) ends: bool,
    signal: Option<i32>,
    logged: bool,
}

impl Trainer<'_> {
    /// The policy's shape.
    pub(super) fn spec(&self) -> &PolicySpec {
        self.policy.spec()
    }

    /// The amount of experience to collect between two updates.
    pub(super) fn collect_until(&self) -> CollectUntil {
        self.algorithm.collect_until()
    }

    /// `[P]` the policy's weights.
    pub(super) fn weights(&self) -> &[f32] {
        self.policy.flat_weights()
    }

    /// The buffers for a rollout and its episodes.
    pub(super) fn collecting(&mut self) -> (&mut Rollout, &mut EpisodeTally) {
        (&mut self.rollout, &mut self.tally)
    }

    /// Duration of the last update, or [`LONG_UPDATE`] before the first. The next update takes about as long. With EPOpt it
    /// takes up to some ten times as long, which is still less than servers wait. Keeping connections alive takes a thread,
    /// which would cost more than the shortest updates.
    pub(super) fn last_update(&self) -> Duration {
        self.last_update.unwrap_or(LONG_UPDATE)
    }

    /// A workspace for [`Trainer::update`], see [`Policy::workspace`].
    pub(super) fn workspace(&self) -> Result<Option<GradientWorkspace>> {
        Ok(self.policy.workspace()?)
    }

    /// Updates the policy from the rollout, which took these times to collect. Gradients are computed in `workspace` if there
    /// is one. A `player` that acted in this process gets the new weights.
    ///
    /// # Errors
    /// A number that is not finite, an episode that did not run with the requested parameters, a full disk.
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
            // At once, while the weights are in the processor's caches.
            player.load(self.policy.flat_weights()).map_err(Error::from)?;
        }
        let elapsed = start.elapsed();
        self.last_update = Some(elapsed);
        self.shares.acting += acting.as_secs_f64();
        self.shares.waiting += waiting.as_secs_f64();
        self.shares.updating += elapsed.as_secs_f64();

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

    /// Logs the rollout's episodes. Returns their number, and the number of steps that the rollout counts.
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

    /// The remaining share of the training: 1 at the start, 0 when the policy has learned from as many steps as the budget's
    /// episodes can have at most. With an update for each episode, every episode counts with the maximal number of steps, as
    /// in the reference, which pads episodes to it.
    fn progress_remaining(&self) -> f64 {
        let State { config, environment_spec, counters, .. } = &self.checkpoint.state;
        if let Wrapper::Epopt(EpoptConfig { update_per_episode: true, .. }) = config.settings.wrapper {
            return (1.0 - counters.episodes as f64 / config.common.episodes as f64).max(0.0);
        }
        let most = config.common.episodes as f64 * f64::from(environment_spec.step_limit);
        (1.0 - counters.learned_timesteps as f64 / most).max(0.0)
    }

    /// Logs the iteration if a log line is due, and decides about checkpoints and the end of the run.
    ///
    /// # Errors
    /// A full disk.
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
        let passed = |mark: &u64| finished || *mark <= progress.episodes; // after its end a policy no longer changes
        let passed = self.marks.partition_point(passed);
        let marks = self.marks.drain(..passed).collect();
        Ok(IterationOutcome { progress, save, marks, ends: finished || signal.is_some(), signal, logged })
    }

    /// Copies the current policy into the checkpoint.
    fn copy_policy(&mut self, normalisers: Normalisers) {
        let Self { policy, checkpoint, .. } = self;
        policy.copy_weights(&mut checkpoint.weights);
        checkpoint.state.observation_normaliser = normalisers.observations;
        checkpoint.state.reward_normaliser = normalisers.rewards;
    }

    /// Keeps the current policy for the marks that were passed. Call it before the next checkpoint is saved: a run that is
    /// resumed from that checkpoint does not pass these marks again.
    ///
    /// # Errors
    /// A full disk.
    pub(super) fn keep(&mut self, iteration: &IterationOutcome, normalisers: &Normalisers) -> Result<()> {
        if !iteration.marks.is_empty() {
            self.copy_policy(normalisers.clone());
        }
        iteration.marks.iter().try_for_each(|&mark| Ok(self.checkpoint.save(&self.directory.mark(mark), None)?))
    }

    /// Replaces the checkpoint on disk. Environments and player are those after the last iteration.
    ///
    /// # Errors
    /// A full disk; the earlier checkpoint, if any, is then still there.
    pub(super) fn save(
        &mut self,
        snapshots: Vec<bytes::Bytes>,
        player: PlayerState,
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

    /// The run's outcome, after the last iteration was saved.
    ///
    /// # Errors
    /// A full disk.
    pub(super) fn end(&mut self, iteration: &IterationOutcome) -> Result<TrainOutcome> {
        if !iteration.logged {
            self.logs.progress(&iteration.progress)?; // a line beyond the checkpoint, which a resumed run deletes
        }
        Ok(TrainOutcome { checkpoint: self.checkpoint.clone(), progress: iteration.progress, signal: iteration.signal })
    }

    /// Wraps an `error` that ended the run, and adds the last checkpoint that is left, if any.
    pub(super) fn failed(&self, error: TrainError) -> TrainError {
        let run = || self.directory.path().to_owned();
        let last = self.saved.map(|Counters { episodes, .. }| LastCheckpoint { episodes, run: run() });
        TrainError::Failed { last, source: Box::new(error) }
    }

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
    /// Notes an episode that ended.
    pub(super) fn note(&mut self, episode: &EndedEpisode) {
        while self.recent.len() >= RECENT {
            self.recent.pop_front();
        }
        self.recent.push_back(episode.into());
        self.ended.push(episode.clone());
    }
}

/// The error of an episode that did not run with the requested parameters.
fn difference(comparison: &mut ParameterComparison, episode: &EndedEpisode) -> Option<TrainError> {
    let receipt = &episode.receipt;
    let difference = comparison.difference_beyond_rounding(&receipt.requested, &receipt.applied)?;
    let EndedEpisode { environment_index, episode_index, .. } = *episode;
    Some(TrainError::NotApplied { environment_index, episode_index, difference })
}
