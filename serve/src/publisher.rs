//! Publishes pages to their subscribers.
//!
//! One task reads the files of the pages that somebody has open. Each subscriber gets the latest event only: a slow one
//! misses the events in between.

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
use crate::links::WayUp;
use crate::pages::{self, Update};
use crate::paths::{RelativePath, Root};
use crate::report::ReportCache;
use crate::runs::Runs;
use crate::server_status::{self, ServerMonitor};
use crate::training::LiveTraining;

/// Maximum number of pages whose files are read at the same time. More would take processors from trainings.
const MAX_CONCURRENT_LOADS: usize = 4;
/// Time after which a round of loads stops waiting. Later results are published when they arrive.
const BROADCAST_TIMEOUT: Duration = Duration::from_secs(2);
/// Time that a new subscriber waits, so that others who arrive with it share one load.
const DEBOUNCE: Duration = Duration::from_millis(50);

/// A page that can be subscribed to.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Topic {
    /// The list of all runs.
    Index,
    /// The run in this folder.
    Run(RelativePath),
}

/// The data of an event, as it is sent. Empty before the first load.
pub(crate) type EventData = Arc<str>;

/// A loaded page.
#[derive(Debug)]
pub(crate) struct View {
    pub(crate) update: Update,
    /// `update` as an event.
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
    /// Notified of each new subscriber.
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

    /// Returns the page of `topic` as it is now, or was at the last load.
    pub(crate) async fn view(self: &Arc<Self>, topic: &Topic) -> Result<Arc<View>, ViewError> {
        let loader = self.loader(topic);
        let this = Arc::clone(self);
        let loaded_topic = topic.clone();
        let view = loader.get(&self.load_permits, move || this.load(&loaded_topic)).await;
        let view = view.unwrap_or_else(|error| Err(ViewError::Load(error)));
        if matches!(view, Err(ViewError::RunNotFound)) {
            // Clients can make up any number of names.
            self.loaders.remove(topic);
        }
        view
    }

    fn loader(&self, topic: &Topic) -> ViewLoader {
        self.loaders.get_or_insert_with(topic.clone(), ViewLoader::default)
    }

    /// Reads the files of `topic`. Blocks.
    fn load(&self, topic: &Topic) -> Result<Arc<View>, ViewError> {
        self.runs.remove_idle();
        self.loaders.remove_idle(ViewLoader::is_loading);
        let way_up = match topic {
            Topic::Index => WayUp::from_index(),
            Topic::Run(relative) => WayUp::from_run(relative),
        };
        let update = self.update(topic)?.with_relative_links(&way_up);
        let event = update.to_json().into();
        Ok(Arc::new(View { update, event }))
    }

    fn update(&self, topic: &Topic) -> Result<Update, ViewError> {
        let root = &self.root;
        let relative = match topic {
            Topic::Index => {
                let index = Index::scan(root, &self.runs).map_err(|error| ViewError::Unlisted(error.to_string()))?;
                let server = self.server.as_ref().map(|server| (server.address(), server.last()));
                return Ok(pages::index::update(root, &index, server.as_ref()));
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
                    pages::assessment::update(root, relative, assessment)
                },
            ),
        })
    }

    /// Adds a subscriber of `topic`. The first value may be empty.
    pub(crate) fn subscribe(&self, topic: Topic) -> watch::Receiver<EventData> {
        let mut topics = self.topics();
        let receiver = topics.entry(topic).or_insert_with(|| watch::channel(EventData::from("")).0).subscribe();
        drop(topics);
        self.subscribed.notify_one();
        receiver
    }

    /// Publishes changes. Never returns.
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
            // New subscribers get their first event during the pause. The others are not loaded sooner for that.
            while tokio::time::timeout_at(next_round, self.subscribed.notified()).await.is_ok() {
                tokio::time::sleep(DEBOUNCE).await;
                self.publish(self.subscribed_topics(|event| event.is_empty())).await;
            }
        }
    }

    /// Returns the topics with subscribers whose last event satisfies `wanted`. Drops those without subscribers.
    fn subscribed_topics(&self, wanted: impl Fn(&EventData) -> bool) -> Vec<Topic> {
        let mut topics = self.topics();
        topics.retain(|_, sender| sender.receiver_count() > 0);
        topics.iter().filter(|(_, sender)| wanted(&sender.borrow())).map(|(topic, _)| topic.clone()).collect()
    }

    /// Loads these topics and sends their events.
    async fn publish(self: &Arc<Self>, topics: Vec<Topic>) {
        // A load that does not end delays no other topic. Topics without an event yet get one, be it an error.
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
        // `publish_topic` sends an error if its load panics, and goes on after the timeout.
        let _ = tokio::time::timeout(BROADCAST_TIMEOUT, futures_util::future::join_all(loads)).await;
    }

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
