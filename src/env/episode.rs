//! The episodes of one environment: drawing of parameters, step limit, success rules and receipts.

use super::{
    Achievement, Action, Distribution, Draw, DrawPurpose, Environment, EnvironmentSpec, PhiloxStream,
    observed_parameters::ObservedParameters,
};
use crate::scene::Scene;
use perturb_protocol::limits::MAX_DRAWN_CONTEXTS;
use std::sync::Arc;

/// The settings that determine the episodes of an environment.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeSettings {
    /// The seed.
    pub seed: u64,
    /// The environment's index. Seed, index and trial number determine the random numbers for the parameters of a
    /// trial. Seed, index and episode number determine all other random numbers of an episode.
    pub environment_index: u32,
    /// The distributions of boxes of the parameter space, one box after the other: two for version R+E, one for other
    /// versions, and this number for each of a session's contexts. A box has a distribution for each parameter, in the
    /// order of [`EnvironmentSpec::parameters`], within the parameters' bounds. Each trial draws all parameters from one
    /// of the boxes, chosen with equal probability.
    pub distributions: Arc<[Distribution]>,
    /// Number of episodes in a trial, at least 1. Parameters are drawn when a trial begins, and kept for all its
    /// episodes.
    pub episodes_per_trial: u32,
}

/// Number of boxes that every environment accepts in a snapshot. Version R+E has two.
const MIN_RESTORED_BOXES: usize = 2;

/// Maximal number of boxes in [`EpisodeSettings::distributions`]. Version R+E has two for each context.
const MAX_BOXES: usize = 2 * MAX_DRAWN_CONTEXTS;

/// The numbers that identify an episode among all episodes of the same seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeId {
    /// The environment's index.
    pub environment_index: u32,
    /// The number of the trial, counted from 0 for each environment.
    pub trial_index: u64,
    /// The number of the episode, counted from 0 for each environment.
    pub episode_index: u64,
    /// The number of the episode in its trial, from 0.
    pub episode_in_trial: u32,
}

/// The physical parameters with which an episode ran.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeReceipt {
    /// The drawn or requested parameters, in the order of [`EnvironmentSpec::parameters`].
    pub requested: Vec<f64>,
    /// The values read back from the physics, in the order of [`EnvironmentSpec::applied`].
    pub applied: Vec<f64>,
    /// The hash of the model's files, see [`Environment::model_hash`].
    pub model_hash: String,
}

/// The start of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct StartedEpisode {
    /// The numbers that identify the episode.
    pub id: EpisodeId,
    /// The receipt with the episode's parameters, if requested.
    pub receipt: Option<EpisodeReceipt>,
}

/// The result of an episode that ended.
#[derive(Debug, Clone, PartialEq)]
pub struct FinishedEpisode {
    /// The numbers that identify the episode.
    pub id: EpisodeId,
    /// The undiscounted sum of rewards.
    pub total_reward: f64,
    /// The number of steps.
    pub length: u32,
    /// The value that the environment's success rule compares; `None` if the episode has no such value.
    pub achieved: Option<f64>,
    /// The value that the success rule of the paper's published code compares; `None` if the episode has no such value.
    pub code_achieved: Option<f64>,
    /// Whether the episode is a success by the environment's success rule.
    pub success: bool,
    /// Whether the physics diverged, i.e. the state is not finite or cannot be sent as float32.
    pub diverged: bool,
    /// The receipt with the episode's parameters, if requested.
    pub receipt: Option<EpisodeReceipt>,
}

/// The result of one step of an episode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outcome {
    /// The sum of the reward's terms.
    pub reward: f64,
    /// Whether the task ended the episode.
    pub terminated: bool,
    /// Whether the step limit ended the episode.
    pub truncated: bool,
}

/// The counters of an environment: the current trial and episode, and the progress of the episode.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub(super) struct EpisodeProgress {
    pub(super) trial: u64,
    pub(super) episode: u64,
    pub(super) episode_in_trial: u32,
    pub(super) length: u32,
    pub(super) total_reward: f64,
    /// The number of the first step, from 1, after which the task's goal was met; 0 if it was not met yet.
    pub(super) reached_at: u32,
    /// How many steps in a row, up to the last one, ended with the task's goal met.
    pub(super) held_for: u32,
    /// The largest number of successive steps of the episode that ended with the task's goal met. Serde skips this
    /// field, because the first format of snapshots lacks it. Later formats store it separately, after the other data.
    #[serde(skip)]
    pub(super) held_longest: u32,
    pub(super) ended: bool,
    pub(super) diverged: bool,
}

/// An environment that runs one episode after another.
pub struct Episodes {
    pub(super) environment: Box<dyn Environment>,
    pub(super) settings: EpisodeSettings,
    /// The parameters of the current trial, in the order of [`EnvironmentSpec::parameters`].
    pub(super) values: Vec<f64>,
    pub(super) progress: EpisodeProgress,
    /// The parameters at the end of each observation; `None` if observations do not include them.
    pub(super) observed_parameters: Option<Box<ObservedParameters>>,
    /// The maximum number of boxes in a restored snapshot. It limits the memory of the environment.
    pub(super) max_boxes: usize,
}

/// Returns the number of boxes of the parameter space that a list of `distributions` distributions describes. Each box
/// has `n` distributions, one for each parameter; without parameters there is one empty box. Returns `None` if the list
/// has a part of a box, no box, or more than [`MAX_BOXES`].
pub(super) fn boxes(distributions: usize, n: usize) -> Option<usize> {
    let boxes = distributions.checked_div(n).unwrap_or(1);
    (boxes * n == distributions && (1..=MAX_BOXES).contains(&boxes)).then_some(boxes)
}

impl Episodes {
    /// Begins the first episode of an environment.
    ///
    /// # Panics
    /// If `settings` does not have one distribution for each parameter in each box.
    pub fn new(environment: Box<dyn Environment>, settings: EpisodeSettings) -> Self {
        let n = environment.spec().parameters.len();
        let boxes = boxes(settings.distributions.len(), n)
            .expect("settings.distributions has one distribution for each parameter in each box");
        let mut episodes = Self {
            environment,
            settings,
            values: vec![0.0; n],
            progress: EpisodeProgress::default(),
            observed_parameters: None,
            max_boxes: boxes.max(MIN_RESTORED_BOXES),
        };
        episodes.start(None);
        episodes
    }

    /// Makes every observation end with the parameters, scaled by
    /// [`ParameterSpec::observed`](super::ParameterSpec::observed).
    pub fn observing_parameters(mut self) -> Self {
        self.observed_parameters = Some(Box::new(ObservedParameters::new(self.environment.as_ref())));
        self
    }

    /// Returns the environment's description.
    pub fn spec(&self) -> &'static EnvironmentSpec {
        self.environment.spec()
    }

    /// Returns the settings that determine the episodes.
    pub fn settings(&self) -> &EpisodeSettings {
        &self.settings
    }

    /// Begins the next episode. If `state` is given, the episode begins in exactly this state, with the entries of
    /// [`EnvironmentSpec::state`].
    pub fn begin(&mut self, state: Option<&[f64]>) {
        let EpisodeProgress { trial, episode, episode_in_trial, .. } = self.progress;
        let same_trial = episode_in_trial + 1 < self.settings.episodes_per_trial;
        self.progress = EpisodeProgress {
            trial: if same_trial { trial } else { trial + 1 },
            episode: episode + 1,
            episode_in_trial: if same_trial { episode_in_trial + 1 } else { 0 },
            ..EpisodeProgress::default()
        };
        self.start(state);
    }

    /// Begins a new trial. `distributions`, if given, replaces the distributions; it must have one distribution for each
    /// parameter in each box. `seed`, if given, replaces the seed and restarts trial and episode numbers at 0. If
    /// `state` is given, the first episode begins in exactly this state.
    pub fn begin_trial(
        &mut self,
        seed: Option<u64>,
        distributions: Option<Arc<[Distribution]>>,
        state: Option<&[f64]>,
    ) {
        if let Some(distributions) = distributions {
            self.settings.distributions = distributions;
        }
        self.progress = match seed {
            Some(seed) => {
                self.settings.seed = seed;
                EpisodeProgress::default()
            }
            None => EpisodeProgress {
                trial: self.progress.trial + 1,
                episode: self.progress.episode + 1,
                ..EpisodeProgress::default()
            },
        };
        self.start(state);
    }

    fn start(&mut self, state: Option<&[f64]>) {
        let EpisodeSettings { seed, environment_index, ref distributions, .. } = self.settings;
        if self.progress.episode_in_trial == 0 {
            let mut stream =
                PhiloxStream::new(seed, environment_index.into(), DrawPurpose::Parameters, self.progress.trial);
            let n = self.values.len();
            let boxes = boxes(distributions.len(), n).unwrap_or(1);
            // No random number is drawn to choose a single box, so versions D, R and E draw one number for each
            // parameter.
            let chosen = if boxes > 1 { (stream.unit() * boxes as f64) as usize } else { 0 };
            let parameters = self.environment.spec().parameters;
            for ((value, distribution), parameter) in
                self.values.iter_mut().zip(&distributions[chosen * n..]).zip(parameters)
            {
                *value = if let Some(fixed) = distribution.fixed_value() {
                    stream.skip(1);
                    fixed
                } else {
                    parameter.draw(distribution, stream.unit())
                };
            }
            self.environment.set_parameters(&self.values);
            self.update_observed_parameters();
        }
        let episode = self.progress.episode;
        self.environment.set_address(Draw { seed, environment_index, episode_index: episode }, 0);
        match state {
            Some(state) => self.environment.reset_to(state),
            None => {
                let mut stream = PhiloxStream::new(seed, environment_index.into(), DrawPurpose::InitialState, episode);
                self.environment.reset(&mut stream);
            }
        }
    }

    /// Draws random numbers of the next step before its action is known, see [`Environment::draw_ahead`].
    pub fn draw_ahead(&mut self) {
        self.environment.draw_ahead();
    }

    /// Advances the current episode by one step. Writes the terms of the reward to `reward_terms`, in the order of
    /// [`EnvironmentSpec::reward_terms`].
    pub fn step(&mut self, action: Action<'_>, reward_terms: &mut [f64]) -> Outcome {
        let transition = self.environment.step(action, reward_terms);
        let reward = reward_terms.iter().sum();
        let progress = &mut self.progress;
        progress.length += 1;
        progress.total_reward += reward;
        if transition.goal {
            progress.held_for += 1;
            progress.held_longest = progress.held_longest.max(progress.held_for);
            if progress.reached_at == 0 {
                progress.reached_at = progress.length;
            }
        } else {
            progress.held_for = 0;
        }
        let truncated = progress.length >= self.environment.spec().step_limit;
        progress.diverged = transition.diverged;
        progress.ended = transition.terminated || truncated;
        Outcome { reward, terminated: transition.terminated, truncated }
    }

    /// Updates the observed parameters, if there are any. Call this method after the environment's parameters were set.
    pub(super) fn update_observed_parameters(&mut self) {
        if let Some(observed_parameters) = &mut self.observed_parameters {
            observed_parameters.read(self.environment.as_ref());
        }
    }

    /// Writes the current observation to `out`, including the observed parameters.
    pub fn observe(&self, out: &mut [f32]) {
        let entries =
            self.observed_parameters.as_ref().map_or(&[][..], |observed_parameters| observed_parameters.entries());
        let (state, parameters) = out.split_at_mut(out.len() - entries.len());
        self.environment.observe(state);
        parameters.copy_from_slice(entries);
    }

    /// Returns the scene to draw for a picture of the current state; `None` after the physics diverged.
    pub fn scene(&self) -> Option<Scene> {
        self.environment.scene()
    }

    /// Whether the current episode has ended.
    pub fn ended(&self) -> bool {
        self.progress.ended
    }

    /// Returns the numbers that identify the current episode.
    pub fn id(&self) -> EpisodeId {
        EpisodeId {
            environment_index: self.settings.environment_index,
            trial_index: self.progress.trial,
            episode_index: self.progress.episode,
            episode_in_trial: self.progress.episode_in_trial,
        }
    }

    /// Returns the numbers that determine the random numbers of the current episode.
    pub fn draw(&self) -> Draw {
        let EpisodeSettings { seed, environment_index, .. } = self.settings;
        Draw { seed, environment_index, episode_index: self.progress.episode }
    }

    /// Returns the receipt of the current episode.
    pub fn receipt(&self) -> EpisodeReceipt {
        let mut applied = vec![0.0; self.spec().applied.len()];
        self.environment.applied(&mut applied);
        EpisodeReceipt { requested: self.values.clone(), applied, model_hash: self.environment.model_hash().into() }
    }

    /// Appends the numbers of the current episode's receipt to `values`: the requested values, then the applied values.
    pub fn push_receipt(&self, values: &mut Vec<f64>) {
        values.extend_from_slice(&self.values);
        let requested = values.len();
        values.resize(requested + self.spec().applied.len(), 0.0);
        self.environment.applied(&mut values[requested..]);
    }

    /// Returns the start of the current episode. `receipt` says whether to include the receipt.
    pub fn started(&self, receipt: bool) -> StartedEpisode {
        StartedEpisode { id: self.id(), receipt: receipt.then(|| self.receipt()) }
    }

    /// Returns the result of the current episode. `receipt` says whether to include the receipt.
    pub fn finished(&self, receipt: bool) -> FinishedEpisode {
        let (progress, spec) = (&self.progress, self.spec());
        let achieved = self.achieved(spec.success.achievement);
        FinishedEpisode {
            id: self.id(),
            total_reward: progress.total_reward,
            length: progress.length,
            success: spec.success.holds(achieved),
            achieved,
            code_achieved: spec.code_success.map_or(achieved, |code| self.achieved(code.achievement)),
            diverged: progress.diverged,
            receipt: receipt.then(|| self.receipt()),
        }
    }

    fn achieved(&self, achievement: Achievement) -> Option<f64> {
        let EpisodeProgress { length, reached_at, held_for, held_longest, .. } = self.progress;
        match achievement {
            Achievement::Length => Some(length.into()),
            Achievement::FirstGoal => (reached_at > 0).then_some(reached_at.into()),
            Achievement::LastGoals => Some(held_for.into()),
            Achievement::LongestGoals => Some(held_longest.into()),
            Achievement::Own(_) => self.environment.achieved(),
        }
    }
}
