//! One task looks at the files for all who look at pages, and only at those that somebody looks at. What it sees, the
//! latest alone, waits for each of them: who is slow misses what was in between.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_study::runs::Kind;
use tokio::sync::{Notify, watch};

use crate::experiment::Experiment;
use crate::index::Index;
use crate::load::{self, Asked};
use crate::pages::{self, Update};
use crate::paths::{Relative, Root};
use crate::report::Reports;
use crate::training::Training;

/// How often files are looked at …
const INTERVAL: Duration = Duration::from_secs(1);
/// … but no more than this share of the time, as one in so many.
const REST: u32 = 5;
/// So many look on at a time.
pub(crate) const MOST_CLIENTS: usize = 64;
/// What nobody has looked at for so long is forgotten.
const FORGET: Duration = Duration::from_secs(600);

/// What one can look at.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Topic {
    /// All runs.
    Index,
    /// The run in this folder.
    Run(Relative),
}

/// Why one cannot look at something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Missing {
    /// There is no run.
    NoRun,
    /// The folder of all runs is gone.
    Gone,
}

/// What is seen, as it is sent.
pub(crate) type Seen = Arc<str>;

/// Looks at files.
#[derive(Debug)]
pub(crate) struct Watch {
    root: Root,
    views: Mutex<Views>,
    topics: Mutex<HashMap<Topic, watch::Sender<Seen>>>,
    /// Somebody has begun to look on.
    begun: Notify,
    reports: Arc<Reports>,
    server: Option<Arc<Asked>>,
}

/// What is known of what was looked at.
#[derive(Debug, Default)]
pub(crate) struct Views {
    pub(crate) trainings: HashMap<PathBuf, Used<Training>>,
    pub(crate) experiments: HashMap<PathBuf, Used<Experiment>>,
}

/// Something, and when it was last looked at.
#[derive(Debug)]
pub(crate) struct Used<T>(T, Instant);

impl Views {
    pub(crate) fn training(&mut self, path: &Path) -> &mut Training {
        let used = self.trainings.entry(path.to_owned()).or_insert_with(|| Used(Training::of(path), Instant::now()));
        used.1 = Instant::now();
        &mut used.0
    }

    pub(crate) fn experiment(&mut self, path: &Path) -> &mut Experiment {
        let new = || Used(Experiment::of(path), Instant::now());
        let used = self.experiments.entry(path.to_owned()).or_insert_with(new);
        used.1 = Instant::now();
        &mut used.0
    }

    fn forget(&mut self) {
        self.trainings.retain(|_, used| used.1.elapsed() < FORGET);
        self.experiments.retain(|_, used| used.1.elapsed() < FORGET);
    }
}

impl Watch {
    pub(crate) fn new(root: Root, reports: Arc<Reports>, server: Option<Arc<Asked>>) -> Self {
        let (views, topics, begun) = (Mutex::default(), Mutex::default(), Notify::new());
        Self { root, views, topics, begun, reports, server }
    }

    /// What there is to see now. Reads files.
    pub(crate) fn see(&self, topic: &Topic) -> Result<Update, Missing> {
        let server = self.server.as_ref().map(|server| (server.address(), server.last()));
        let mut views = self.views.lock().unwrap_or_else(PoisonError::into_inner);
        match topic {
            Topic::Index => {
                let index = Index::look(&self.root, &mut views).map_err(|_| Missing::Gone)?;
                Ok(pages::index::update(&self.root, &index, server.as_ref()))
            }
            Topic::Run(relative) => {
                let path = self.root.resolve(relative).ok_or(Missing::NoRun)?;
                match Kind::of(&path).ok_or(Missing::NoRun)? {
                    Kind::Training => {
                        let training = views.training(&path);
                        training.follow();
                        Ok(pages::training::update(&self.root, relative, &path, training))
                    }
                    Kind::Experiment => {
                        let experiment = views.experiment(&path);
                        experiment.follow();
                        let report = self.reports.state(&path, experiment.files());
                        Ok(pages::experiment::update(&self.root, relative, &path, experiment, report))
                    }
                }
            }
        }
    }

    /// Has `topic` looked at for one more; `None` if too many look on already. The first value may be empty.
    pub(crate) fn subscribe(&self, topic: Topic) -> Option<watch::Receiver<Seen>> {
        let mut topics = self.topics();
        let clients: usize = topics.values().map(watch::Sender::receiver_count).sum();
        if clients >= MOST_CLIENTS {
            return None;
        }
        let receiver = topics.entry(topic).or_insert_with(|| watch::channel(Seen::from("")).0).subscribe();
        drop(topics);
        self.begun.notify_one();
        Some(receiver)
    }

    /// Looks, for ever.
    pub(crate) async fn run(self: Arc<Self>) {
        let mut asked: Option<Instant> = None;
        loop {
            let topics = self.watched();
            if topics.is_empty() {
                self.begun.notified().await;
                continue;
            }
            if let Some(server) = self.server.as_ref().filter(|_| asked.is_none_or(|at| at.elapsed() >= load::INTERVAL))
            {
                asked = Some(Instant::now());
                tokio::spawn(Arc::clone(server).ask());
            }
            let (begun, this) = (Instant::now(), Arc::clone(&self));
            let look = move || {
                topics.iter().for_each(|topic| this.look(topic));
                this.views.lock().unwrap_or_else(PoisonError::into_inner).forget();
            };
            if let Err(error) = tokio::task::spawn_blocking(look).await {
                tracing::error!("the files were not looked at: {error}");
            }
            let rest = INTERVAL.max(begun.elapsed() * REST);
            // Who has just come is not kept waiting, but does not hurry anybody either.
            tokio::select! {
                () = tokio::time::sleep(rest) => {}
                () = self.begun.notified() => tokio::time::sleep(Duration::from_millis(100)).await,
            }
        }
    }

    /// What somebody looks at.
    fn watched(&self) -> Vec<Topic> {
        let mut topics = self.topics();
        topics.retain(|_, sender| sender.receiver_count() > 0);
        topics.keys().cloned().collect()
    }

    fn look(&self, topic: &Topic) {
        let seen = match self.see(topic) {
            Ok(update) => update.to_json(),
            Err(missing) => pages::gone(missing).to_json(),
        };
        if let Some(sender) = self.topics().get(topic) {
            sender.send_if_modified(|last| {
                let new = **last != *seen;
                if new {
                    *last = seen.into();
                }
                new
            });
        }
    }

    fn topics(&self) -> MutexGuard<'_, HashMap<Topic, watch::Sender<Seen>>> {
        self.topics.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
