//! Recorded test episodes, with the requested parameters, the applied parameters and the outcome of each.
//!
//! The tests of one policy are in one Parquet file. Every figure of a test result can be computed from this file, for
//! any success threshold. Each episode can be replayed from its seed, environment index and episode index.

mod checksum;
mod columns;
mod parquet;
mod replay;

pub use parquet::{FILE, RecordsError};

use perturb_protocol::{EndedEpisode, proto};
use perturb_settings::sets::TestSet;
use perturb_settings::{ValueError, require};
use serde::{Deserialize, Serialize};

use crate::axis::Axis;
use crate::results::TestResult;
use crate::statistics::{mean, wilson};
use crate::success::{Criterion, Rule};

/// Maximum relative difference between a requested and an applied value. The difference is not 0, because physics
/// rounds derived quantities.
pub const ROUNDING: f64 = 1e-9;

/// The recorded tests of one policy.
#[derive(Clone, Debug, PartialEq)]
pub struct Records {
    /// Metadata of all episodes.
    pub about: RecordsMetadata,
    /// The episodes, in the order of the tests. Within a test they are ordered by environment index, then episode
    /// index.
    pub episodes: Vec<EpisodeRecord>,
}

/// Metadata of a policy's recorded episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordsMetadata {
    /// The environment's name.
    pub environment: String,
    /// The environment's revision.
    pub revision: u32,
    /// The environment's parameters, in the order of the requested values.
    pub parameters: Vec<RecordedParameter>,
    /// The names of the quantities that the server read back from the physics, in the order of the applied values.
    pub applied: Vec<String>,
    /// The id of the tested checkpoint. For a policy that is no checkpoint, a name such as "function upright".
    pub policy: String,
    /// The number of episodes in a trial of RL². Only the last episode of each trial is recorded. 1 for other policies.
    pub episodes_per_trial: u32,
    /// The success criterion; `None` if the server determined success without stating its criterion.
    pub success: Option<Criterion>,
    /// The environment's own success criterion. In the paper's environments, this is the one in the paper of Packer et
    /// al. (2018). `None` if `code_success` is `None`; this includes records of older programs, which had only one
    /// criterion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text_success: Option<Criterion>,
    /// The success criterion in the published code of Packer et al. (2018). `None` if the server did not report it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub code_success: Option<Criterion>,
    /// The name of the quantity in [`EpisodeRecord::also_achieved`]. `None` if the criteria of the paper and of its
    /// code compare the same quantity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub also: Option<String>,
    /// The tests, in the order in which they were recorded.
    pub tests: Vec<RecordedTest>,
}

/// An environment parameter of recorded episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedParameter {
    /// The parameter's name.
    pub name: String,
    /// The unit; "1" if dimensionless.
    pub unit: String,
    /// The name of the applied quantity that holds this parameter's value in the physics. Empty if the server did not
    /// state it.
    pub applied: String,
}

/// A recorded test.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedTest {
    /// The test set.
    pub set: TestSet,
    /// The seed of the test's environments and actions.
    pub seed: u64,
    /// The axes x and y, if the test is a heatmap. `None` for other tests and in records of older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub axes: Option<[Axis; 2]>,
}

/// The reason why an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// The task ended the episode, for example because of a fall.
    Terminated,
    /// The step limit ended the episode.
    Truncated,
    /// The physics computed numbers that are not finite.
    Diverged,
}

/// A recorded episode of a test.
#[derive(Clone, Debug, PartialEq)]
pub struct EpisodeRecord {
    /// The name of the test set.
    pub set: String,
    /// The seed of the test's environments. The seed, the environment index and the episode index identify the episode.
    pub seed: u64,
    /// The index of the environment within the test, from 0.
    pub environment_index: u32,
    /// The index of the episode in its environment, from 0.
    pub episode_index: u64,
    /// The requested parameter values, in the order of [`RecordsMetadata::parameters`].
    pub requested: Vec<f64>,
    /// The applied values that were read back from the physics, in the order of [`RecordsMetadata::applied`].
    pub applied: Vec<f64>,
    /// SHA-256 of the model's MJCF text, or of all files of the task folder that the server read. Empty for an
    /// environment without a model.
    pub model_hash: String,
    /// The undiscounted sum of the rewards.
    pub episode_return: f64,
    /// The number of steps.
    pub length: u32,
    /// Whether the episode was a success.
    pub success: bool,
    /// The reason why the episode ended.
    pub ending: Ending,
    /// The value of the quantity that the success criterion compares. `None` if the episode has no such value.
    pub achieved: Option<f64>,
    /// The value of the quantity [`RecordsMetadata::also`]. `None` if there is no such quantity, or the episode has no
    /// value of it.
    pub also_achieved: Option<f64>,
}

/// The result of comparing requested with applied parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterCheck {
    /// The number of episodes in which all parameters were compared.
    pub episodes: u64,
    /// The largest relative difference; `None` if no parameter was compared.
    pub largest: Option<Difference>,
}

/// The difference between the requested value of a parameter and the value that the physics used.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Difference {
    /// The parameter's name in the catalogue.
    pub parameter: String,
    /// The requested value.
    pub requested: f64,
    /// The applied value.
    pub applied: f64,
    /// The absolute difference, divided by the magnitude of the requested value unless this value is 0.
    pub relative: f64,
}

impl RecordsMetadata {
    /// Returns the metadata for a policy in `environment`, without any tests.
    pub fn new(environment: &proto::Environment, policy: String, episodes_per_trial: u32) -> Self {
        let parameter = |parameter: &proto::Parameter| RecordedParameter {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            applied: parameter.applied.clone(),
        };
        let (text, code) = (Criterion::from_environment(environment), Criterion::from_environment_code(environment));
        let quantities = text.as_ref().zip(code.as_ref()).map(|(text, code)| (&text.quantity, &code.quantity));
        let also = quantities.filter(|(text, code)| text != code).map(|(_, code)| code.clone());
        Self {
            environment: environment.name.clone(),
            revision: environment.revision,
            parameters: environment.parameters.iter().map(parameter).collect(),
            applied: environment.applied.iter().map(|quantity| quantity.name.clone()).collect(),
            policy,
            episodes_per_trial,
            success: text.clone(),
            text_success: code.as_ref().and(text),
            code_success: code,
            also,
            tests: Vec::new(),
        }
    }

    /// Returns the success criterion that `rule` stands for.
    ///
    /// # Errors
    /// [`ValueError`] if these episodes cannot be judged by `rule`.
    pub fn criterion(&self, rule: &Rule) -> Result<Criterion, ValueError> {
        rule.criterion(self.text_success.as_ref().or(self.success.as_ref()), self.code_success.as_ref())
    }

    /// Uses `rule` as the success criterion of all episodes that are recorded from now on.
    ///
    /// # Errors
    /// The errors of [`RecordsMetadata::criterion`].
    pub fn judge_by(&mut self, rule: &Rule) -> Result<(), ValueError> {
        let criterion = self.criterion(rule)?;
        if self.also.as_ref() == Some(&criterion.quantity) {
            self.also = self.success.take().map(|before| before.quantity);
        }
        self.success = Some(criterion);
        Ok(())
    }

    /// Returns two values of an episode. The first is the quantity that the success criterion compares. The second is
    /// the environment's other quantity, or `None` if both criteria compare the same quantity.
    fn achieved(&self, end: &EndedEpisode) -> (Option<f64>, Option<f64>) {
        let text = (end.achieved, self.also.is_some().then_some(end.code_achieved).flatten());
        if self.is_judged_by_code() { (text.1, text.0) } else { text }
    }

    /// Returns whether [`EpisodeRecord::achieved`] holds the quantity of [`RecordsMetadata::code_success`]. Returns
    /// false if both criteria compare the same quantity.
    pub fn is_judged_by_code(&self) -> bool {
        let quantity = |criterion: &Option<Criterion>| criterion.as_ref().map(|it| it.quantity.clone());
        self.also.is_some() && quantity(&self.success) == quantity(&self.code_success)
    }
}

impl EpisodeRecord {
    /// Creates the record of an episode of the test on `set`, whose environments have the seed `seed`.
    pub fn new(about: &RecordsMetadata, set: &str, seed: u64, end: EndedEpisode) -> Self {
        let (achieved, also_achieved) = about.achieved(&end);
        Self {
            set: set.to_owned(),
            seed,
            environment_index: end.environment_index,
            episode_index: end.episode_index,
            ending: match (end.diverged, end.terminated) {
                (true, _) => Ending::Diverged,
                (false, true) => Ending::Terminated,
                (false, false) => Ending::Truncated,
            },
            requested: end.receipt.requested,
            applied: end.receipt.applied,
            model_hash: end.receipt.model_hash,
            episode_return: end.episode_return,
            length: end.length,
            success: about.success.as_ref().map_or(end.success, |criterion| criterion.holds(achieved)),
            achieved,
            also_achieved,
        }
    }
}

impl Records {
    /// Creates records without any tests.
    pub fn new(about: RecordsMetadata) -> Self {
        Self { about, episodes: Vec::new() }
    }

    /// Adds a test with its episodes.
    pub fn add(&mut self, test: RecordedTest, episodes: Vec<EpisodeRecord>) {
        self.about.tests.push(test);
        self.episodes.extend(episodes);
    }

    /// Adds the tests and episodes of `other`, which must be of the same policy.
    pub fn append(&mut self, other: Self) {
        self.about.tests.extend(other.about.tests);
        self.episodes.extend(other.episodes);
    }

    /// Returns the episodes of the test on the set called `name`.
    pub fn episodes_on<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a EpisodeRecord> + Clone {
        self.episodes.iter().filter(move |episode| episode.set == name)
    }

    /// Computes the results of the test on the set called `name`. With `criterion`, determines success by this
    /// criterion instead of the recorded one. The quantity of `criterion` must have been recorded.
    pub fn result(&self, name: &str, criterion: Option<&Criterion>) -> TestResult {
        let success =
            |episode: &EpisodeRecord| criterion.map_or(episode.success, |c| c.holds(self.achieved(episode, c)));
        let episodes: Vec<&EpisodeRecord> = self.episodes_on(name).collect();
        let n = episodes.len() as u64;
        let successes = episodes.iter().filter(|episode| success(episode)).count() as u64;
        let (low, high) = wilson(successes, n);
        TestResult {
            episodes: n,
            success_percent: 100.0 * successes as f64 / n as f64,
            success_percent_95: [100.0 * low, 100.0 * high],
            mean_return: mean(episodes.iter().map(|episode| episode.episode_return)),
            mean_length: mean(episodes.iter().map(|episode| f64::from(episode.length))),
        }
    }

    /// Determines the success of all episodes by `rule` instead of the recorded criterion.
    ///
    /// # Errors
    /// The errors of [`RecordsMetadata::criterion`].
    pub fn judged_by(mut self, rule: &Rule) -> Result<Self, ValueError> {
        let criterion = self.about.criterion(rule)?;
        let swaps = self.about.also.as_ref() == Some(&criterion.quantity);
        for episode in &mut self.episodes {
            if swaps {
                std::mem::swap(&mut episode.achieved, &mut episode.also_achieved);
            }
            episode.success = criterion.holds(episode.achieved);
        }
        self.about.judge_by(rule)?;
        Ok(self)
    }

    /// Determines the success of all episodes by a criterion whose quantity was not recorded. `values` has the quantity
    /// for each episode, NaN if the episode has no value. The recorded values are replaced by `values`.
    ///
    /// # Errors
    /// [`ValueError`] if the number of values is not the number of episodes.
    pub fn judged_by_values(mut self, criterion: Criterion, values: &[f64]) -> Result<Self, ValueError> {
        let expected = format!("{}, one for each episode", self.episodes.len());
        require(
            values.len() == self.episodes.len(),
            "the number of values of the rule of success",
            values.len(),
            expected,
        )?;
        for (episode, &value) in self.episodes.iter_mut().zip(values) {
            episode.achieved = Some(value).filter(|value| !value.is_nan());
            episode.also_achieved = None;
            episode.success = criterion.holds(episode.achieved);
        }
        let about = &mut self.about;
        (about.success, about.text_success, about.code_success, about.also) = (Some(criterion), None, None, None);
        Ok(self)
    }

    /// Returns the episode's value of the quantity that `criterion` compares.
    pub fn achieved(&self, episode: &EpisodeRecord, criterion: &Criterion) -> Option<f64> {
        if self.about.also.as_ref() == Some(&criterion.quantity) { episode.also_achieved } else { episode.achieved }
    }

    /// Compares the requested with the applied parameters of all episodes.
    pub fn agreement(&self) -> ParameterCheck {
        let comparison = ParameterComparison::with(&self.about);
        let of = |episode: &EpisodeRecord| comparison.largest(&episode.requested, &episode.applied);
        let largest = self.episodes.iter().filter_map(of).max_by(|a, b| a.relative.total_cmp(&b.relative));
        let episodes = if comparison.is_complete() { self.episodes.len() as u64 } else { 0 };
        ParameterCheck { episodes, largest }
    }
}

/// Compares the requested with the applied parameters of single episodes.
#[derive(Clone, Debug)]
pub struct ParameterComparison {
    /// The name of each parameter, and the index of its quantity among the applied values. The index is `None` if the
    /// server did not state the quantity.
    parameters: Vec<(String, Option<usize>)>,
}

impl ParameterComparison {
    fn with(about: &RecordsMetadata) -> Self {
        let place = |parameter: &RecordedParameter| about.applied.iter().position(|name| *name == parameter.applied);
        let parameters = about.parameters.iter().map(|parameter| (parameter.name.clone(), place(parameter)));
        Self { parameters: parameters.collect() }
    }

    /// Creates a comparison for episodes of `environment`.
    pub fn new(environment: &proto::Environment) -> Self {
        Self::with(&RecordsMetadata::new(environment, String::new(), 1))
    }

    /// Returns the largest relative difference between an episode's requested and applied values. Returns `None` if it
    /// is within rounding.
    pub fn difference_beyond_rounding(&self, requested: &[f64], applied: &[f64]) -> Option<Difference> {
        self.largest(requested, applied).filter(Difference::exceeds_tolerance)
    }

    /// Returns whether every parameter has an applied quantity.
    fn is_complete(&self) -> bool {
        self.parameters.iter().all(|(_, place)| place.is_some())
    }

    /// Returns the largest relative difference between an episode's requested and applied values. Returns `None` if no
    /// parameter has an applied quantity. A missing value counts as a difference of NaN.
    fn largest(&self, requested: &[f64], applied: &[f64]) -> Option<Difference> {
        let value = |values: &[f64], place: usize| values.get(place).copied().unwrap_or(f64::NAN);
        let compared = self.parameters.iter().enumerate().filter_map(|(index, (name, place))| {
            let (requested, applied) = (value(requested, index), value(applied, (*place)?));
            Some((name, requested, applied, relative(requested, applied)))
        });
        let largest = compared.max_by(|a, b| a.3.total_cmp(&b.3));
        largest.map(|(name, requested, applied, relative)| Difference {
            parameter: name.clone(),
            requested,
            applied,
            relative,
        })
    }
}

/// Returns the absolute difference, divided by the magnitude of `requested` unless this is 0.
fn relative(requested: f64, applied: f64) -> f64 {
    let difference = (applied - requested).abs();
    // Makes every NaN positive, because `total_cmp` orders a positive NaN above all numbers.
    let relative = if requested == 0.0 { difference } else { difference / requested.abs() };
    if relative.is_nan() { f64::NAN } else { relative }
}

impl Difference {
    /// Returns whether the relative difference exceeds [`ROUNDING`] or is NaN.
    pub fn exceeds_tolerance(&self) -> bool {
        self.relative.is_nan() || self.relative > ROUNDING
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { parameter, requested, applied, .. } = self;
        write!(f, "the parameter {parameter} was requested as {requested}, but the physics ran with {applied}")
    }
}

#[cfg(test)]
mod tests;
