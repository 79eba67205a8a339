//! Plays episodes and films them.

use std::time::{Duration, Instant};

use super::panel::{Panel, Shown, ShownEnding, parameter};
use super::{VideoError, VideoFile, VideoWriter};
use perturb_learner::checkpoint::{Checkpoint, EnvironmentSummary, State};
use perturb_learner::client::{BegunEpisode, ClientError, Picture, Servers, Single, StepReply};
use perturb_learner::evaluation::{TestError, check_unchanged, open_options, player};
use perturb_learner::proto;
use perturb_policy::{Ended, Player};
use perturb_study::interrupt::StopFlag;
use perturb_study::sets::TestSet;

/// The end of an episode stays for so many seconds.
const HOLD: f64 = 1.0;

/// What to film.
#[derive(Clone, Debug)]
pub struct VideoOptions {
    /// Where parameters come from: a version, or a set whose parameters are drawn.
    pub set: TestSet,
    /// How many episodes, at least 1.
    pub episodes: u64,
    /// Fixes all randomness.
    pub seed: u64,
    /// Of the pictures, in pixels, [`super::PIXELS`]; frames are higher by the text below.
    pub size: (u32, u32),
    /// Frames shown in a second, more than 0; `None` is real time.
    pub fps: Option<f64>,
}

/// An episode that was filmed.
#[derive(Clone, Debug, PartialEq)]
pub struct Filmed {
    /// The parameters' names and values, in the catalogue's order.
    pub parameters: Vec<(String, f64)>,
    /// The undiscounted sum of its rewards.
    pub episode_return: f64,
    /// Its number of steps.
    pub length: u32,
    /// Whether it was a success.
    pub success: bool,
}

/// What was filmed, and how fast.
#[derive(Clone, Debug, Default)]
pub struct Footage {
    /// In order.
    pub episodes: Vec<Filmed>,
    /// One for each step and one for each episode's start.
    pub frames: u64,
    /// Of a frame, width and height in pixels.
    pub size: (u32, u32),
    /// Simulated seconds that pass in one second of the video: 1 is real time.
    pub speed: f64,
    /// From the first request to the finished file.
    pub total: Duration,
    /// The part of it that passed with waiting for the server.
    pub waiting: Duration,
    /// The part of it that passed with drawing text, encoding and writing.
    pub writing: Duration,
}

/// Plays `options.episodes` episodes with the policy of `checkpoint`, sampled actions and frozen statistics, and writes
/// them to `file`: a frame of the start of each episode and one after each step. Calls `report` with the number of
/// episodes done.
///
/// It is environment 0 of a test with the same seed: what is filmed of one episode is what a test of one episode sees. Of
/// a policy that was trained in trials all episodes of a trial are filmed, and the policy remembers them.
///
/// # Errors
/// [`VideoError`]; the file is then not there.
pub fn film(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &VideoOptions,
    file: VideoFile,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Footage, VideoError> {
    let start = Instant::now();
    let mut film = Film::open(servers, checkpoint, options)?;
    film.footage.speed = film.environment.control_timestep / file.frame_seconds(film.fps);
    let mut writer = file.begin(film.footage.size, film.fps)?;
    loop {
        if let Some(signal) = stop.signal() {
            return Err(TestError::Stopped { signal }.into());
        }
        // The next step is on its way before the picture of this state is there: server and learner work at once.
        let next = film.request_next()?;
        film.expose(&mut writer)?;
        match next {
            Next::Step => film.step()?,
            Next::Episode => film.begin()?,
            Next::Nothing => break,
        }
        report(film.footage.episodes.len() as u64);
    }
    let completing = Instant::now();
    writer.finish()?;
    film.footage.writing += completing.elapsed();
    film.footage.total = start.elapsed();
    Ok(film.footage)
}

/// What follows a state.
enum Next {
    Step,
    Episode,
    Nothing,
}

/// A policy that acts and is filmed.
struct Film<'a> {
    options: &'a VideoOptions,
    state: &'a State,
    single: Single<'a>,
    environment: proto::Environment,
    player: Player,
    ended: Vec<Ended>,
    reply: StepReply,
    begun: BegunEpisode,
    panel: Panel,
    shown: Shown,
    /// The last picture.
    last: Option<Picture>,
    frame: Vec<u8>,
    fps: f64,
    footage: Footage,
}

impl<'a> Film<'a> {
    /// At the start of the first episode, whose picture has been asked for.
    fn open(servers: &'a Servers, checkpoint: &'a Checkpoint, options: &'a VideoOptions) -> Result<Self, VideoError> {
        let state = &checkpoint.state;
        let open = open_options(&state.config, &options.set, options.seed);
        let mut reply = StepReply::default();
        let (single, begun) = Single::open(servers, &open, &mut reply.observations)?;
        check_unchanged(checkpoint, EnvironmentSummary::of(single.environment()))?;
        let environment = single.environment().clone();
        options.set.check(&environment).map_err(TestError::Value)?;
        let mut player = player(checkpoint, 1, open.seed).map_err(TestError::Numbers)?;
        player.begin(&reply.observations, None).map_err(TestError::Numbers)?;
        let title = (
            format!("{} {}", environment.name, options.set.name),
            format!("{}, trained on {}", state.config.method(), state.config.common.trained_on()),
        );
        let panel = Panel::new(options.size, title, environment.parameters.len())?;
        let mut film = Self {
            options,
            state,
            single,
            player,
            ended: Vec::new(),
            reply,
            shown: Shown::default(),
            last: None,
            frame: Vec::new(),
            fps: options.fps.unwrap_or(1.0 / environment.control_timestep),
            footage: Footage { size: panel.size(), ..Footage::default() },
            begun,
            panel,
            environment,
        };
        film.announce();
        film.request_picture()?;
        Ok(film)
    }

    /// Asks for what follows the present state, and for a picture of that.
    fn request_next(&mut self) -> Result<Next, VideoError> {
        let next = if self.shown.ending.is_none() {
            let action = self.player.act().map_err(TestError::Numbers)?;
            self.single.request_step(action)?;
            Next::Step
        } else if (self.footage.episodes.len() as u64) < self.options.episodes {
            self.single.request_reset()?;
            Next::Episode
        } else {
            return Ok(Next::Nothing);
        };
        self.request_picture()?;
        Ok(next)
    }

    fn request_picture(&mut self) -> Result<(), VideoError> {
        let (width, height) = self.options.size;
        Ok(self.single.request_picture(width, height)?)
    }

    /// Takes the picture of the present state, and writes its frame.
    fn expose(&mut self, writer: &mut VideoWriter) -> Result<(), VideoError> {
        let asked = Instant::now();
        let picture = match (self.single.picture(), &self.last) {
            // Physics that diverged ends its episode and cannot be drawn: the picture before it stays.
            (Err(ClientError::Refused { code, .. }), Some(last))
                if code == tonic::Code::FailedPrecondition && self.shown.ending.is_some() =>
            {
                last.clone()
            }
            (picture, _) => picture?,
        };
        let came = Instant::now();
        self.panel.compose(&picture, &self.shown, &mut self.frame)?;
        writer.write(&self.frame, if self.shown.ending.is_some() { HOLD } else { 0.0 })?;
        self.footage.frames += 1;
        self.last = Some(picture);
        self.footage.waiting += came - asked;
        self.footage.writing += came.elapsed();
        Ok(())
    }

    /// Takes the outcome of a step.
    fn step(&mut self) -> Result<(), VideoError> {
        let asked = Instant::now();
        self.single.stepped(&mut self.reply)?;
        self.footage.waiting += asked.elapsed();
        let Self { reply, shown, player, ended, .. } = self;
        player.observe(&reply.all().outcome(ended), None).map_err(TestError::Numbers)?;
        shown.step += 1;
        shown.time = f64::from(shown.step) * self.environment.control_timestep;
        shown.episode_return += f64::from(reply.rewards[0]);
        let Some(end) = reply.ended.pop() else { return Ok(()) };
        shown.episode_return = end.episode_return;
        let truncated = reply.truncated[0];
        shown.ending = Some(ShownEnding { success: end.success, terminated: end.terminated, truncated });
        let names = self.environment.parameters.iter().map(|parameter| parameter.name.clone());
        self.footage.episodes.push(Filmed {
            parameters: names.zip(self.begun.parameters.iter().copied()).collect(),
            episode_return: end.episode_return,
            length: end.length,
            success: end.success,
        });
        Ok(())
    }

    /// Takes the start of the next episode.
    fn begin(&mut self) -> Result<(), VideoError> {
        let asked = Instant::now();
        self.begun = self.single.begun(&mut self.reply.observations)?;
        self.player.see(0, &self.reply.observations).map_err(TestError::Numbers)?;
        self.footage.waiting += asked.elapsed();
        self.announce();
        Ok(())
    }

    /// Shows the episode that has begun.
    fn announce(&mut self) {
        let (number, episodes) = (self.footage.episodes.len() + 1, self.options.episodes);
        let trial = match self.state.config.settings.episodes_per_trial() {
            1 => String::new(),
            _ => format!(", trial {}", self.begun.trial_index + 1),
        };
        let parameters = self.environment.parameters.iter().zip(&self.begun.parameters);
        self.shown = Shown {
            episode: format!("episode {number} of {episodes}{trial}"),
            parameters: parameters.map(|(known, value)| parameter(&known.name, *value, &known.unit)).collect(),
            ..Shown::default()
        };
    }
}
