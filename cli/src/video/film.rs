//! Plays episodes and films them.

use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::client::{BegunEpisode, ClientError, Picture, Servers, Single, StepReply};
use perturb_learner::evaluation::{TestError, open_options};
use perturb_learner::proto;
use perturb_policy::{Ended, Player};
use perturb_records::success::Criterion;
use perturb_settings::sets::TestSet;

use super::panel::{Panel, Shown, ShownEnding, parameter};
use super::{Grid, VideoError, VideoFile, VideoWriter};

/// The end of an episode stays for so many seconds.
const HOLD: f64 = 2.0;

/// What to film.
#[derive(Clone, Debug)]
pub struct VideoOptions {
    /// Where parameters come from, at least one: versions, or sets whose parameters are drawn.
    pub sets: Vec<TestSet>,
    /// How many episodes on each, at least 1.
    pub episodes: u64,
    /// Fixes all randomness.
    pub seed: u64,
    /// Of the pictures, in pixels, [`super::PIXELS`]; frames are higher by the text below.
    pub size: (u32, u32),
    /// Frames shown in a second, more than 0; `None` is real time.
    pub fps: Option<f64>,
    /// Steps from one frame to the next, at least 1; the first state and the last are always shown.
    pub every: u32,
}

/// An episode that was filmed.
#[derive(Clone, Debug, PartialEq)]
pub struct Filmed {
    /// What set its parameters are from.
    pub set: String,
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
    /// In order: those of the first set, of the second, …
    pub episodes: Vec<Filmed>,
    /// One for each step, or for some of them, and one for each episode's start.
    pub frames: u64,
    /// Of so many of them the video shows one: 1 if it shows all.
    pub shown_every: u16,
    /// Of the video, width and height in pixels.
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

impl Footage {
    /// What is to be said of a video that does not show all frames.
    pub fn thinning(&self) -> Option<String> {
        (self.shown_every > 1).then(|| {
            format!(
                "one frame of {} is shown, so that the GIF has at most 2 MB: a smaller --width or fewer --episodes show \
                 more of them, and an .mp4 all",
                self.shown_every
            )
        })
    }
}

/// Plays `options.episodes` episodes on each set with the policy of `checkpoint`, sampled actions and frozen statistics,
/// and writes them to `file`: a frame of the start of each episode and one after each step. Calls `report` with the number
/// of episodes done.
///
/// On each set it is environment 0 of a test with the same seed: what is filmed of one episode is what a test of one episode sees. Of
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
    let (mut footage, mut place) = (Footage::default(), Place::Empty(file));
    for set in &options.sets {
        let mut film = Film::open(servers, checkpoint, options, set, footage)?;
        let mut writer = place.begin(&mut film)?;
        film.run(&mut writer, stop, report)?;
        (footage, place) = (film.footage, Place::Begun(writer));
    }
    if let Place::Begun(writer) = place {
        let completing = Instant::now();
        footage.shown_every = writer.finish()?;
        footage.writing += completing.elapsed();
    }
    footage.total = start.elapsed();
    Ok(footage)
}

/// Where frames go, whose size the first film knows.
enum Place {
    Empty(VideoFile),
    Begun(VideoWriter),
}

impl Place {
    fn begin(self, film: &mut Film<'_>) -> Result<VideoWriter, VideoError> {
        let file = match self {
            Self::Empty(file) => file,
            Self::Begun(writer) => return Ok(writer),
        };
        film.footage.speed = film.frame_seconds() / file.frame_seconds(film.fps);
        let grid = Grid { sets: film.options.sets.len(), episodes: film.options.episodes as usize };
        let writer = file.begin(film.panel.size(), film.fps, grid)?;
        film.footage.size = writer.size();
        Ok(writer)
    }
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
    set: &'a TestSet,
    /// Episodes that the sets before have.
    before: usize,
    state: &'a State,
    single: Single<'a>,
    environment: proto::Environment,
    player: Player,
    ended: Vec<Ended>,
    reply: StepReply,
    begun: BegunEpisode,
    panel: Panel,
    shown: Shown,
    /// Whether a picture of the present state was asked for, and of the next one.
    pictured: [bool; 2],
    /// The last picture.
    last: Option<Picture>,
    frame: Vec<u8>,
    fps: f64,
    footage: Footage,
}

impl<'a> Film<'a> {
    /// At the start of the first episode, whose picture has been asked for.
    fn open(
        servers: &'a Servers,
        checkpoint: &'a Checkpoint,
        options: &'a VideoOptions,
        set: &'a TestSet,
        footage: Footage,
    ) -> Result<Self, VideoError> {
        let state = &checkpoint.state;
        let open = open_options(&state.config, set, options.seed);
        let mut reply = StepReply::default();
        let (single, begun) = Single::open(servers, &open, &mut reply.observations)?;
        checkpoint.state.check_unchanged(single.environment()).map_err(TestError::from)?;
        let environment = single.environment().clone();
        set.check(&environment).map_err(TestError::Value)?;
        let mut player = checkpoint.player(1, open.seed, 0).map_err(TestError::Numbers)?;
        player.begin(&reply.observations, None).map_err(TestError::Numbers)?;
        let title = (
            format!("{} {}", environment.name, set.name),
            format!("{}, trained on {}", state.config.method(), state.config.common.trained_on()),
        );
        let rule = Criterion::of(&environment).map_or_else(String::new, |criterion| format!("success: {criterion}"));
        let panel = Panel::new(options.size, title, rule.replace('_', " "), environment.parameters.len())?;
        let mut film = Self {
            options,
            set,
            before: footage.episodes.len(),
            state,
            single,
            player,
            ended: Vec::new(),
            reply,
            shown: Shown::default(),
            pictured: [true, true],
            last: None,
            frame: Vec::new(),
            fps: options.fps.unwrap_or(1.0 / (f64::from(options.every) * environment.control_timestep)),
            footage,
            begun,
            panel,
            environment,
        };
        film.announce();
        film.request_picture()?;
        Ok(film)
    }

    fn run(
        &mut self,
        writer: &mut VideoWriter,
        stop: &StopFlag,
        report: &mut dyn FnMut(u64),
    ) -> Result<(), VideoError> {
        loop {
            if let Some(signal) = stop.signal() {
                return Err(TestError::Stopped { signal }.into());
            }
            // The next step is on its way before the picture of this state is there: server and learner work at once.
            let next = self.request_next()?;
            self.expose(writer)?;
            match next {
                Next::Step => self.step()?,
                Next::Episode => self.begin()?,
                Next::Nothing => return Ok(()),
            }
            report(self.footage.episodes.len() as u64);
        }
    }

    /// Episodes on this set.
    fn episodes(&self) -> usize {
        self.footage.episodes.len() - self.before
    }

    /// How much simulated time a frame stands for, s.
    fn frame_seconds(&self) -> f64 {
        f64::from(self.options.every) * self.environment.control_timestep
    }

    /// Asks for what follows the present state, and for a picture of that if it is to be shown.
    fn request_next(&mut self) -> Result<Next, VideoError> {
        self.pictured[1] = true;
        let next = if self.shown.ending.is_none() {
            let action = self.player.act().map_err(TestError::Numbers)?;
            self.single.request_step(action)?;
            self.pictured[1] = (self.shown.step + 1).is_multiple_of(self.options.every);
            Next::Step
        } else if (self.episodes() as u64) < self.options.episodes {
            self.single.request_reset()?;
            Next::Episode
        } else {
            return Ok(Next::Nothing);
        };
        if self.pictured[1] {
            self.request_picture()?;
        }
        Ok(next)
    }

    fn request_picture(&mut self) -> Result<(), VideoError> {
        let (width, height) = self.options.size;
        Ok(self.single.request_picture(width, height)?)
    }

    /// Takes the picture of the present state, if one was asked for, and writes its frame.
    fn expose(&mut self, writer: &mut VideoWriter) -> Result<(), VideoError> {
        if !self.pictured[0] {
            return Ok(());
        }
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
        let is_end = self.shown.ending.is_some();
        writer.write(&self.frame, if is_end { HOLD } else { 0.0 })?;
        if is_end {
            writer.end_episode();
        }
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
        self.pictured[0] = self.pictured[1];
        let Self { reply, shown, player, ended, .. } = self;
        player.observe(&reply.all().outcome(ended), None).map_err(TestError::Numbers)?;
        shown.step += 1;
        shown.time = f64::from(shown.step) * self.environment.control_timestep;
        shown.episode_return += f64::from(reply.rewards[0]);
        let Some(end) = reply.ended.pop() else { return Ok(()) };
        shown.episode_return = end.episode_return;
        let truncated = reply.truncated[0];
        shown.ending = Some(ShownEnding { success: end.success, terminated: end.terminated, truncated });
        if let (Some(rule), Some(achieved)) = (&self.environment.success, end.achieved) {
            shown.achieved = parameter(&rule.quantity.replace('_', " "), achieved, &rule.unit);
        }
        let names = self.environment.parameters.iter().map(|parameter| parameter.name.clone());
        self.footage.episodes.push(Filmed {
            set: self.set.name.clone(),
            parameters: names.zip(self.begun.parameters.iter().copied()).collect(),
            episode_return: end.episode_return,
            length: end.length,
            success: end.success,
        });
        if !self.pictured[0] {
            self.request_picture()?; // nothing else has been asked for yet
            self.pictured[0] = true;
        }
        Ok(())
    }

    /// Takes the start of the next episode.
    fn begin(&mut self) -> Result<(), VideoError> {
        let asked = Instant::now();
        self.begun = self.single.begun(&mut self.reply.observations)?;
        self.pictured[0] = true;
        self.player.see(0, &self.reply.observations).map_err(TestError::Numbers)?;
        self.footage.waiting += asked.elapsed();
        self.announce();
        Ok(())
    }

    /// Shows the episode that has begun.
    fn announce(&mut self) {
        let (number, episodes) = (self.episodes() + 1, self.options.episodes);
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
