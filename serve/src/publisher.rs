//! Loads pages, and publishes their changes to subscribers.
//!
//! A subscriber is a browser that has a page open. [`Publisher::run`] loads all open pages again and again. A
//! subscriber always gets the latest event, so a slow subscriber misses events in between.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_experiment::runs::RunKind;
use tokio::sync::{Notify, Semaphore, watch};

use crate::assessment::LiveAssessment;
use crate::cached_loader::{CachedLoader, pause_after};
use crate::error::ViewError;
use crate::experiment::LiveExperiment;
use crate::index::Index;
use crate::keyed_cache::KeyedCache;
use crate::links::RelativeRoot;
use crate::pages::curves::ChartedTraining;
use crate::pages::{self, Update};
use crate::paths::{RelativePath, Root};
use crate::report::ReportCache;
use crate::runs::Runs;
use crate::server_status::{self, ServerMonitor};
use crate::training::LiveTraining;

/// Maximum number of pages whose files are read at the same time. The limit leaves processor time to trainings.
const MAX_CONCURRENT_LOADS: usize = 4;
/// Maximum time for which [`Publisher::publish`] waits until all its pages are loaded. Pages that take longer are
/// published as soon as they are loaded.
const BROADCAST_TIMEOUT: Duration = Duration::from_secs(2);
/// Time between a new subscription and its load, so that subscriptions that arrive together share one load.
const DEBOUNCE: Duration = Duration::from_millis(50);

/// A page, as the subject of requests and subscriptions.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Topic {
    /// The list of all runs.
    Index,
    /// The run in this folder.
    Run(RelativePath),
    /// The learning curves of these trainings.
    Curves(Vec<RelativePath>),
}

/// The data of an event as it is sent to browsers. It is empty before the first event of a page.
pub(crate) type EventData = Arc<str>;

/// A loaded page.
#[derive(Debug)]
pub(crate) struct View {
    pub(crate) update: Update,
    /// The data of the event that sends `update` to browsers.
    event: EventData,
}

type ViewLoader = CachedLoader<Result<Arc<View>, ViewError>>;

/// Loads pages for requests and for subscribers.
#[derive(Debug)]
pub(crate) struct Publisher {
    root: Root,
    runs: Runs,
    loaders: KeyedCache<Topic, ViewLoader>,
    load_permits: Arc<Semaphore>,
    topics: Mutex<HashMap<Topic, watch::Sender<EventData>>>,
    /// Is notified when there is a new subscriber.
    subscribed: Notify,
    reports: Arc<ReportCache>,
    server: Option<Arc<ServerMonitor>>,
}

impl Publisher {
    pub(crate) fn new(root: Root, reports: Arc<ReportCache>, server: Option<Arc<ServerMonitor>>) -> Self {
        Self {
            root,
            runs: Runs::default(),
            loaders: KeyedCache::default(),
            load_permits: Arc::new(Semaphore::new(MAX_CONCURRENT_LOADS)),
            topics: Mutex::default(),
            subscribed: Notify::new(),
            reports,
            server,
        }
    }

    /// Returns the page of `topic`. Loads it again if the pause since the last load is over.
    pub(crate) async fn view(self: &Arc<Self>, topic: &Topic) -> Result<Arc<View>, ViewError> {
        let loader = self.loader(topic);
        let this = Arc::clone(self);
        let loaded_topic = topic.clone();
        let view = loader.get(&self.load_permits, move || this.load(&loaded_topic)).await;
        let view = view.unwrap_or_else(|error| Err(ViewError::Load(error)));
        if matches!(view, Err(ViewError::RunNotFound)) {
            // Pages that do not exist are not cached, because clients can request any number of them.
            self.loaders.remove(topic);
        }
        view
    }

    fn loader(&self, topic: &Topic) -> ViewLoader {
        self.loaders.get_or_insert_with(topic.clone(), ViewLoader::default)
    }

    /// Reads the files of `topic` and makes its page. Blocks the thread.
    fn load(&self, topic: &Topic) -> Result<Arc<View>, ViewError> {
        self.runs.remove_idle();
        self.loaders.remove_idle(ViewLoader::is_loading);
        let relative_root = match topic {
            Topic::Index | Topic::Curves(_) => RelativeRoot::from_index(),
            Topic::Run(relative) => RelativeRoot::from_run(relative),
        };
        let update = self.update(topic)?.with_relative_links(&relative_root);
        let event = update.to_json().into();
        Ok(Arc::new(View { update, event }))
    }

    /// Refreshes the state of the list or run that `topic` names, and returns the content of its page.
    fn update(&self, topic: &Topic) -> Result<Update, ViewError> {
        let root = &self.root;
        let relative = match topic {
            Topic::Index => {
                let index = Index::scan(root, &self.runs).map_err(|error| ViewError::Unlisted(error.to_string()))?;
                let server = self.server.as_ref().map(|server| (server.address(), server.last()));
                return Ok(pages::index::update(root, &index, server.as_ref()));
            }
            Topic::Curves(chosen) => {
                let found: Vec<_> = chosen.iter().filter_map(|relative| self.charted_training(relative)).collect();
                let update = pages::curves::update(root, chosen, &found);
                return if found.is_empty() { Err(ViewError::RunNotFound) } else { Ok(update) };
            }
            Topic::Run(relative) => relative,
        };
        let path = root.resolve(relative).ok_or(ViewError::RunNotFound)?;
        Ok(match RunKind::detect(&path).ok_or(ViewError::RunNotFound)? {
            RunKind::Training => self.runs.trainings.with(
                &path,
                || LiveTraining::new(root.path(), &path),
                |training| {
                    training.refresh_details();
                    pages::training::update(root, relative, &path, training)
                },
            ),
            RunKind::Experiment => self.runs.experiments.with(
                &path,
                || LiveExperiment::new(root.path(), &path),
                |experiment| {
                    experiment.refresh_details();
                    let report = self.reports.fingerprint(&path, experiment.report_fingerprint());
                    pages::experiment::update(root, relative, &path, experiment, report)
                },
            ),
            RunKind::Assessment => self.runs.assessments.with(
                &path,
                || LiveAssessment::new(root.path(), &path),
                |assessment| {
                    assessment.refresh();
                    let report = self.reports.fingerprint(&path, assessment.report_fingerprint());
                    pages::assessment::update(root, relative, assessment, report)
                },
            ),
        })
    }

    /// Returns the training in a folder with its curve. Returns `None` if there is no training.
    fn charted_training(&self, relative: &RelativePath) -> Option<ChartedTraining> {
        let path = self.root.resolve(relative)?;
        let is_training = RunKind::detect(&path) == Some(RunKind::Training);
        is_training.then(|| {
            self.runs.trainings.with(
                &path,
                || LiveTraining::new(self.root.path(), &path),
                |training| {
                    training.refresh_details();
                    ChartedTraining::new(&self.root, relative, training)
                },
            )
        })
    }

    /// Adds a subscriber of `topic`. The receiver's first value is the last event, or empty if there was none yet.
    pub(crate) fn subscribe(&self, topic: Topic) -> watch::Receiver<EventData> {
        let mut topics = self.topics();
        let receiver = topics.entry(topic).or_insert_with(|| watch::channel(EventData::from("")).0).subscribe();
        drop(topics);
        self.subscribed.notify_one();
        receiver
    }

    /// Loads the subscribed pages again and again, and publishes their changes. Never returns.
    pub(crate) async fn run(self: Arc<Self>) {
        let mut polled: Option<Instant> = None;
        loop {
            let topics = self.subscribed_topics(|_| true);
            if topics.is_empty() {
                self.subscribed.notified().await;
                tokio::time::sleep(DEBOUNCE).await;
                continue;
            }
            let poll_is_due = polled.is_none_or(|at| at.elapsed() >= server_status::POLL_INTERVAL);
            if let Some(server) = self.server.as_ref().filter(|_| poll_is_due) {
                polled = Some(Instant::now());
                tokio::spawn(Arc::clone(server).poll());
            }
            let start = Instant::now();
            self.publish(topics).await;
            let next_round = tokio::time::Instant::now() + pause_after(start.elapsed());
            // During the pause, loads only the pages of new subscribers that have not received any event.
            while tokio::time::timeout_at(next_round, self.subscribed.notified()).await.is_ok() {
                tokio::time::sleep(DEBOUNCE).await;
                self.publish(self.subscribed_topics(|event| event.is_empty())).await;
            }
        }
    }

    /// Drops topics without subscribers. Returns the remaining topics whose last event satisfies `wanted`.
    fn subscribed_topics(&self, wanted: impl Fn(&EventData) -> bool) -> Vec<Topic> {
        let mut topics = self.topics();
        topics.retain(|topic, sender| {
            let has_subscribers = sender.receiver_count() > 0;
            if !has_subscribers && matches!(topic, Topic::Curves(_)) {
                // Remove this entry of the cache immediately: clients can choose any number of combinations of trainings.
                self.loaders.remove(topic);
            }
            has_subscribers
        });
        topics.iter().filter(|(_, sender)| wanted(&sender.borrow())).map(|(topic, _)| topic.clone()).collect()
    }

    /// Loads the pages of `topics`, and sends events to their subscribers.
    async fn publish(self: &Arc<Self>, topics: Vec<Topic>) {
        // A page that is still being loaded is skipped, so that it does not delay others. A page that has not sent an
        // event yet is never skipped, so that its subscribers get at least an error.
        let is_due = |topic: &Topic| {
            let has_event = self.topics().get(topic).is_some_and(|sender| !sender.borrow().is_empty());
            !(has_event && self.loader(topic).is_loading())
        };
        let loads: Vec<_> = topics
            .into_iter()
            .filter(is_due)
            .map(|topic| {
                let this = Arc::clone(self);
                tokio::spawn(async move { this.publish_topic(&topic).await })
            })
            .collect();
        // A timeout is ignored, because `publish_topic` continues in its own task. It sends an error if its load
        // panics.
        let _ = tokio::time::timeout(BROADCAST_TIMEOUT, futures_util::future::join_all(loads)).await;
    }

    /// Loads the page of `topic`, and sends it to the subscribers if it differs from their last event.
    async fn publish_topic(self: &Arc<Self>, topic: &Topic) {
        let event = match self.view(topic).await {
            Ok(view) => Arc::clone(&view.event),
            Err(error) => pages::error_event(&error).into(),
        };
        if let Some(sender) = self.topics().get(topic) {
            sender.send_if_modified(|last| {
                let is_new = **last != *event;
                if is_new {
                    *last = event;
                }
                is_new
            });
        }
    }

    fn topics(&self) -> MutexGuard<'_, HashMap<Topic, watch::Sender<EventData>>> {
        self.topics.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
