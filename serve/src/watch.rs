//! One task looks at the files for all who look at pages, and only at those that somebody looks at. What it sees, the
//! latest alone, waits for each of them: who is slow misses what was in between.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_study::runs::Kind;
use tokio::sync::{Notify, Semaphore, watch};

use crate::experiment::Experiment;
use crate::index::Index;
use crate::load::{self, Asked};
use crate::paced::{Paced, Trouble, rest};
use crate::pages::{self, Update};
use crate::paths::{Relative, Root};
use crate::report::Reports;
use crate::shelf::{FORGET, Shelf};
use crate::training::Training;

/// So many look on at a time.
pub(crate) const MOST_CLIENTS: usize = 64;
/// So many things are looked at at a time: more would only take the processors from trainings.
const MOST_LOOKS: usize = 4;
/// So long those who look on wait for what is looked at at once; what takes longer is told when it is seen.
const TOGETHER: Duration = Duration::from_secs(2);
/// Who has just come waits so long for others who come with him.
const GATHER: Duration = Duration::from_millis(50);

/// What one can look at.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Topic {
    /// All runs.
    Index,
    /// The run in this folder.
    Run(Relative),
}

/// Why one cannot look at something.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Missing {
    /// There is no run.
    NoRun,
    /// The folder of all runs cannot be listed, for this reason.
    Gone(String),
    /// Looking has failed.
    Not(Trouble),
}

/// What is seen, as it is sent.
pub(crate) type Seen = Arc<str>;

/// What is seen, for pages and as it is sent.
#[derive(Debug)]
pub(crate) struct Shown {
    pub(crate) update: Update,
    json: Seen,
}

/// A look at something, and when somebody last wanted it.
type Look = (Paced<Result<Arc<Shown>, Missing>>, Instant);

/// Looks at files.
#[derive(Debug)]
pub(crate) struct Watch {
    root: Root,
    views: Views,
    /// The last looks.
    looks: Mutex<HashMap<Topic, Look>>,
    room: Arc<Semaphore>,
    topics: Mutex<HashMap<Topic, watch::Sender<Seen>>>,
    /// Somebody has begun to look on.
    begun: Notify,
    reports: Arc<Reports>,
    server: Option<Arc<Asked>>,
}

/// What is known of what was looked at.
#[derive(Debug, Default)]
pub(crate) struct Views {
    pub(crate) trainings: Shelf<Training>,
    pub(crate) experiments: Shelf<Experiment>,
}

impl Watch {
    pub(crate) fn new(root: Root, reports: Arc<Reports>, server: Option<Arc<Asked>>) -> Self {
        let (views, looks, room) = (Views::default(), Mutex::default(), Arc::new(Semaphore::new(MOST_LOOKS)));
        Self { root, views, looks, room, topics: Mutex::default(), begun: Notify::new(), reports, server }
    }

    /// What there is to see, now or a moment ago.
    pub(crate) async fn see(self: &Arc<Self>, topic: &Topic) -> Result<Arc<Shown>, Missing> {
        let paced = self.paced(topic);
        let (this, asked) = (Arc::clone(self), topic.clone());
        let seen = paced.see(&self.room, move || this.look(&asked)).await;
        let seen = seen.unwrap_or_else(|trouble| Err(Missing::Not(trouble)));
        if matches!(seen, Err(Missing::NoRun)) {
            self.looks().remove(topic); // names are many
        }
        seen
    }

    fn paced(&self, topic: &Topic) -> Paced<Result<Arc<Shown>, Missing>> {
        let mut looks = self.looks();
        let (paced, used) = looks.entry(topic.clone()).or_insert_with(|| (Paced::default(), Instant::now()));
        *used = Instant::now();
        paced.clone()
    }

    /// Reads files.
    fn look(&self, topic: &Topic) -> Result<Arc<Shown>, Missing> {
        self.views.trainings.forget();
        self.views.experiments.forget();
        self.looks().retain(|_, (look, used)| used.elapsed() < FORGET || look.is_busy());
        let update = self.update(topic)?;
        let json = update.to_json().into();
        Ok(Arc::new(Shown { update, json }))
    }

    fn update(&self, topic: &Topic) -> Result<Update, Missing> {
        let root = &self.root;
        let relative = match topic {
            Topic::Index => {
                let index = Index::look(root, &self.views).map_err(|error| Missing::Gone(error.to_string()))?;
                let server = self.server.as_ref().map(|server| (server.address(), server.last()));
                return Ok(pages::index::update(root, &index, server.as_ref()));
            }
            Topic::Run(relative) => relative,
        };
        let path = root.resolve(relative).ok_or(Missing::NoRun)?;
        Ok(match Kind::of(&path).ok_or(Missing::NoRun)? {
            Kind::Training => self.views.trainings.with(
                &path,
                || Training::of(root.path(), &path),
                |training| {
                    training.follow();
                    pages::training::update(root, relative, &path, training)
                },
            ),
            Kind::Experiment => self.views.experiments.with(
                &path,
                || Experiment::of(root.path(), &path),
                |experiment| {
                    experiment.follow();
                    let report = self.reports.state(&path, experiment.files());
                    pages::experiment::update(root, relative, &path, experiment, report)
                },
            ),
        })
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
            let topics = self.watched(|_| true);
            if topics.is_empty() {
                self.begun.notified().await;
                tokio::time::sleep(GATHER).await;
                continue;
            }
            if let Some(server) = self.server.as_ref().filter(|_| asked.is_none_or(|at| at.elapsed() >= load::INTERVAL))
            {
                asked = Some(Instant::now());
                tokio::spawn(Arc::clone(server).ask());
            }
            let begun = Instant::now();
            self.tell(topics).await;
            let next = tokio::time::Instant::now() + rest(begun.elapsed());
            // Who has just come is not kept waiting, and does not hurry anybody else either.
            while tokio::time::timeout_at(next, self.begun.notified()).await.is_ok() {
                tokio::time::sleep(GATHER).await;
                self.tell(self.watched(|seen| seen.is_empty())).await;
            }
        }
    }

    /// What somebody looks at, where the last that was seen is as `is` says.
    fn watched(&self, is: impl Fn(&Seen) -> bool) -> Vec<Topic> {
        let mut topics = self.topics();
        topics.retain(|_, sender| sender.receiver_count() > 0);
        topics.iter().filter(|(_, sender)| is(&sender.borrow())).map(|(topic, _)| topic.clone()).collect()
    }

    /// Looks at these, and tells who looks on.
    async fn tell(self: &Arc<Self>, topics: Vec<Topic>) {
        // One that does not end keeps no other waiting; whoever has just come is told something.
        let is_due = |topic: &Topic| {
            let told = self.topics().get(topic).is_some_and(|sender| !sender.borrow().is_empty());
            !(told && self.paced(topic).is_busy())
        };
        let looks: Vec<_> = topics
            .into_iter()
            .filter(is_due)
            .map(|topic| {
                let this = Arc::clone(self);
                tokio::spawn(async move { this.tell_of(&topic).await })
            })
            .collect();
        // A look that panics is told as such, and a late one goes on.
        let _ = tokio::time::timeout(TOGETHER, futures_util::future::join_all(looks)).await;
    }

    async fn tell_of(self: &Arc<Self>, topic: &Topic) {
        let seen = match self.see(topic).await {
            Ok(shown) => Arc::clone(&shown.json),
            Err(missing) => pages::gone(&missing).into(),
        };
        if let Some(sender) = self.topics().get(topic) {
            sender.send_if_modified(|last| {
                let new = **last != *seen;
                if new {
                    *last = seen;
                }
                new
            });
        }
    }

    fn topics(&self) -> MutexGuard<'_, HashMap<Topic, watch::Sender<Seen>>> {
        self.topics.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn looks(&self) -> MutexGuard<'_, HashMap<Topic, Look>> {
        self.looks.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
