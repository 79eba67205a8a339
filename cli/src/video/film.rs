//! Plays episodes and films them.

use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::{Checkpoint, State};
use perturb_learner::client::{BegunEpisode, ClientError, RenderSession, RenderedPicture, Servers, StepReply};
use perturb_learner::evaluation::{TestError, open_options};
use perturb_learner::proto;
use perturb_policy::{Player, SlotEnd};
use perturb_records::success::Criterion;
use perturb_settings::sets::TestSet;

use super::caption::{Caption, CaptionText, ShownEnding, parameter};
use super::{EpisodeGrid, VideoError, VideoFile, VideoWriter};

/// Time for which the last frame of an episode is shown, in seconds.
const LAST_FRAME_SECONDS: f64 = 2.0;

/// Options of a film.
#[derive(Clone, Debug)]
pub struct VideoOptions {
    /// Sets of parameters, at least one: versions, or sets whose parameters are drawn.
    pub sets: Vec<TestSet>,
    /// Number of episodes on each set, at least 1.
    pub episodes: u64,
    /// Random seed.
    pub seed: u64,
    /// Width and height of the pictures in pixels, within [`super::PIXELS`]. Frames also have the caption below.
    pub size: (u32, u32),
    /// Frames per second, more than 0; `None` for real time.
    pub fps: Option<f64>,
    /// Number of steps between two frames, at least 1. The first and the last state of an episode are always shown.
    pub every: u32,
}

/// The parameters and the outcome of a filmed episode.
#[derive(Clone, Debug, PartialEq)]
pub struct Filmed {
    /// Name of the set that the parameters come from.
    pub set: String,
    /// Names and values of the parameters, in the catalogue's order.
    pub parameters: Vec<(String, f64)>,
    /// Undiscounted sum of the rewards.
    pub episode_return: f64,
    /// Number of steps.
    pub length: u32,
    /// Whether the episode was a success.
    pub success: bool,
}

/// The result of filming: the episodes, and the properties of the video.
#[derive(Clone, Debug, Default)]
pub struct Footage {
    /// The filmed episodes: all of the first set, then all of the second set, and so on.
    pub episodes: Vec<Filmed>,
    /// Number of frames: one for each shown step, and one for each episode's start.
    pub frames: u64,
    /// n if the video is a film that shows only every n-th frame, and otherwise 1.
    pub shown_every: u16,
    /// Width and height of the video, in pixels.
    pub size: (u32, u32),
    /// Simulated seconds per second of the video; 1 is real time.
    pub speed: f64,
    /// Time from the first request to the finished file.
    pub total: Duration,
    /// Part of `total` that was spent waiting for the server.
    pub waiting: Duration,
    /// Part of `total` that was spent drawing captions, encoding and writing.
    pub writing: Duration,
}

impl Footage {
    /// Returns a note for the user if the video does not show all frames.
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

/// Plays `options.episodes` episodes on each set and writes them to `file`: a frame of each episode's start, and a
/// frame after each shown step. The policy of `checkpoint` samples its actions, and its normalisers do not change.
/// Calls `report` with the number of finished episodes.
///
/// The film shows environment 0 of a test with the same seed, so a film of one episode shows the episode of a test with
/// one episode. An RL² policy keeps its memory during a trial. Each episode of the trial counts as an episode of the
/// film, although a test counts only the trial's last episode.
///
/// # Errors
/// [`VideoError`]. After an error, no file is left.
pub fn film(
    servers: &Servers,
    checkpoint: &Checkpoint,
    options: &VideoOptions,
    file: VideoFile,
    stop: &StopFlag,
    report: &mut dyn FnMut(u64),
) -> Result<Footage, VideoError> {
    let start = Instant::now();
    let mut footage = Footage::default();
    let mut output = FilmOutput::Empty(file);
    for set in &options.sets {
        let mut film = Film::open(servers, checkpoint, options, set, footage)?;
        let mut writer = output.begin(&mut film)?;
        film.run(&mut writer, stop, report)?;
        (footage, output) = (film.footage, FilmOutput::Begun(writer));
    }
    if let FilmOutput::Begun(writer) = output {
        let completing = Instant::now();
        footage.shown_every = writer.finish()?;
        footage.writing += completing.elapsed();
    }
    footage.total = start.elapsed();
    Ok(footage)
}

/// The output of the frames. Encoding begins with the first set's film, because only an open [`Film`] knows the size of
/// frames.
enum FilmOutput {
    Empty(VideoFile),
    Begun(VideoWriter),
}

impl FilmOutput {
    fn begin(self, film: &mut Film<'_>) -> Result<VideoWriter, VideoError> {
        let file = match self {
            Self::Empty(file) => file,
            Self::Begun(writer) => return Ok(writer),
        };
        film.footage.speed = film.frame_seconds() / file.frame_seconds(film.fps);
        let grid = EpisodeGrid { sets: film.options.sets.len(), episodes: film.options.episodes as usize };
        let writer = file.begin(film.caption.size(), film.fps, grid)?;
        film.footage.size = writer.size();
        Ok(writer)
    }
}

/// The request that [`Film::request_next`] has sent: a step, the start of the next episode, or nothing after the last
/// episode.
enum NextRequest {
    Step,
    Episode,
    Nothing,
}

/// Films a policy on one set.
struct Film<'a> {
    options: &'a VideoOptions,
    set: &'a TestSet,
    /// Number of episodes that were filmed on earlier sets.
    before: usize,
    state: &'a State,
    single: RenderSession<'a>,
    environment: proto::Environment,
    player: Player,
    ended: Vec<SlotEnd>,
    reply: StepReply,
    begun: BegunEpisode,
    caption: Caption,
    caption_text: CaptionText,
    /// Whether a picture of the current state was requested, and whether a picture of the next state was requested.
    picture_requested: [bool; 2],
    /// The last picture that was received.
    last: Option<RenderedPicture>,
    frame: Vec<u8>,
    fps: f64,
    footage: Footage,
}

impl<'a> Film<'a> {
    /// Opens the environment and requests the picture of the first episode's start.
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
        let (single, begun) = RenderSession::open(servers, &open, &mut reply.observations)?;
        checkpoint.state.check_unchanged(single.environment()).map_err(TestError::from)?;
        let environment = single.environment().clone();
        set.check(&environment).map_err(TestError::Value)?;
        let mut player = checkpoint.player(1, open.seed, 0).map_err(TestError::Numbers)?;
        player.begin(&reply.observations, None).map_err(TestError::Numbers)?;
        let title = (
            format!("{} {}", environment.name, set.name),
            format!("{}, trained on {}", state.config.method(), state.config.common.trained_on()),
        );
        let rule = Criterion::from_environment(&environment)
            .map_or_else(String::new, |criterion| format!("success: {criterion}"));
        let caption = Caption::new(options.size, title, rule.replace('_', " "), environment.parameters.len())?;
        let mut film = Self {
            options,
            set,
            before: footage.episodes.len(),
            state,
            single,
            player,
            ended: Vec::new(),
            reply,
            caption_text: CaptionText::default(),
            picture_requested: [true, true],
            last: None,
            frame: Vec::new(),
            fps: options.fps.unwrap_or(1.0 / (f64::from(options.every) * environment.control_timestep)),
            footage,
            begun,
            caption,
            environment,
        };
        film.reset_caption();
        film.request_picture()?;
        Ok(film)
    }

    /// Plays and films all episodes on the set.
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
            // The next step is requested before the picture of this state arrives, so that server and client work in
            // parallel.
            let next = self.request_next()?;
            self.write_frame(writer)?;
            match next {
                NextRequest::Step => self.step()?,
                NextRequest::Episode => self.begin()?,
                NextRequest::Nothing => return Ok(()),
            }
            report(self.footage.episodes.len() as u64);
        }
    }

    /// Returns the number of finished episodes on this set.
    fn episodes(&self) -> usize {
        self.footage.episodes.len() - self.before
    }

    /// Returns the simulated time between two frames, in seconds.
    fn frame_seconds(&self) -> f64 {
        f64::from(self.options.every) * self.environment.control_timestep
    }

    /// Requests the next state, and a picture of it if it will be shown.
    fn request_next(&mut self) -> Result<NextRequest, VideoError> {
        self.picture_requested[1] = true;
        let next = if self.caption_text.ending.is_none() {
            let action = self.player.act().map_err(TestError::Numbers)?;
            self.single.request_step(action)?;
            self.picture_requested[1] = (self.caption_text.step + 1).is_multiple_of(self.options.every);
            NextRequest::Step
        } else if (self.episodes() as u64) < self.options.episodes {
            self.single.request_reset()?;
            NextRequest::Episode
        } else {
            return Ok(NextRequest::Nothing);
        };
        if self.picture_requested[1] {
            self.request_picture()?;
        }
        Ok(next)
    }

    fn request_picture(&mut self) -> Result<(), VideoError> {
        let (width, height) = self.options.size;
        Ok(self.single.request_picture(width, height)?)
    }

    /// Receives the picture of the current state, if one was requested, and writes a frame.
    fn write_frame(&mut self, writer: &mut VideoWriter) -> Result<(), VideoError> {
        if !self.picture_requested[0] {
            return Ok(());
        }
        let asked = Instant::now();
        let picture = match (self.single.picture(), &self.last) {
            // The server cannot draw a diverged state, which ends its episode. Show the last picture again.
            (Err(ClientError::Refused { code, .. }), Some(last))
                if code == tonic::Code::FailedPrecondition && self.caption_text.ending.is_some() =>
            {
                last.clone()
            }
            (picture, _) => picture?,
        };
        let came = Instant::now();
        self.caption.compose(&picture, &self.caption_text, &mut self.frame)?;
        let is_end = self.caption_text.ending.is_some();
        writer.write(&self.frame, if is_end { LAST_FRAME_SECONDS } else { 0.0 })?;
        if is_end {
            writer.end_episode();
        }
        self.footage.frames += 1;
        self.last = Some(picture);
        self.footage.waiting += came - asked;
        self.footage.writing += came.elapsed();
        Ok(())
    }

    /// Receives the result of a step.
    fn step(&mut self) -> Result<(), VideoError> {
        let asked = Instant::now();
        self.single.stepped(&mut self.reply)?;
        self.footage.waiting += asked.elapsed();
        self.picture_requested[0] = self.picture_requested[1];
        let Self { reply, caption_text, player, ended, .. } = self;
        player.observe(&reply.all().outcome(ended), None).map_err(TestError::Numbers)?;
        caption_text.step += 1;
        caption_text.time = f64::from(caption_text.step) * self.environment.control_timestep;
        caption_text.episode_return += f64::from(reply.rewards[0]);
        let Some(end) = reply.ended.pop() else { return Ok(()) };
        caption_text.episode_return = end.episode_return;
        let truncated = reply.truncated[0];
        caption_text.ending = Some(ShownEnding { success: end.success, terminated: end.terminated, truncated });
        if let (Some(rule), Some(achieved)) = (&self.environment.success, end.achieved) {
            caption_text.achieved = parameter(&rule.quantity.replace('_', " "), achieved, &rule.unit);
        }
        let names = self.environment.parameters.iter().map(|parameter| parameter.name.clone());
        self.footage.episodes.push(Filmed {
            set: self.set.name.clone(),
            parameters: names.zip(self.begun.parameters.iter().copied()).collect(),
            episode_return: end.episode_return,
            length: end.length,
            success: end.success,
        });
        if !self.picture_requested[0] {
            // Request a picture of the final state even if it is not due after this step. No reset was requested
            // yet, so the server still has the state.
            self.request_picture()?;
            self.picture_requested[0] = true;
        }
        Ok(())
    }

    /// Receives the start of the next episode.
    fn begin(&mut self) -> Result<(), VideoError> {
        let asked = Instant::now();
        self.begun = self.single.begun(&mut self.reply.observations)?;
        self.picture_requested[0] = true;
        self.player.replace_observation(0, &self.reply.observations).map_err(TestError::Numbers)?;
        self.footage.waiting += asked.elapsed();
        self.reset_caption();
        Ok(())
    }

    /// Updates the caption for the new episode.
    fn reset_caption(&mut self) {
        let number = self.episodes() + 1;
        let episodes = self.options.episodes;
        let trial = match self.state.config.settings.episodes_per_trial() {
            1 => String::new(),
            _ => format!(", trial {}", self.begun.trial_index + 1),
        };
        let parameters = self.environment.parameters.iter().zip(&self.begun.parameters);
        self.caption_text = CaptionText {
            episode: format!("episode {number} of {episodes}{trial}"),
            parameters: parameters.map(|(known, value)| parameter(&known.name, *value, &known.unit)).collect(),
            ..CaptionText::default()
        };
    }
}
