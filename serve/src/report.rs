//! The reports of experiments as they stand: made one at a time, kept while nothing changes, and made again so seldom that
//! trainings do not notice.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_study::Folder;
use perturb_study::report::{ReportError, Sources, Whole};

/// So many are kept.
const MOST: usize = 4;
/// One is made again at the earliest after so long …
const LEAST: Duration = Duration::from_secs(5);
/// … and after so many times as long as it took.
const REST: u32 = 10;
/// So long somebody waits for one.
const PATIENCE: Duration = Duration::from_secs(60);

/// Reports by the folders of their experiments.
#[derive(Debug, Default)]
pub(crate) struct Reports {
    made: Mutex<HashMap<PathBuf, Made>>,
    /// Whoever has it makes one.
    turn: tokio::sync::Mutex<()>,
}

/// A report.
#[derive(Clone, Debug)]
struct Made {
    /// Of what it was made.
    state: u64,
    page: Result<Arc<str>, String>,
    at: Instant,
    took: Duration,
}

impl Made {
    /// Whether it is as good as a new one, or too new to be made again.
    fn serves(&self, state: u64) -> bool {
        self.state == state || self.at.elapsed() < LEAST.max(self.took * REST)
    }
}

impl Reports {
    /// The state of which a report would be sent now: `state`, which the files have, or an earlier one.
    pub(crate) fn state(&self, folder: &Path, state: u64) -> u64 {
        self.known().get(folder).filter(|made| made.serves(state)).map_or(state, |made| made.state)
    }

    /// The page of the experiment in `folder`, whose files have this `state`; in its place what is wrong.
    pub(crate) async fn page(self: &Arc<Self>, folder: &Path, state: u64) -> Result<Arc<str>, String> {
        let (this, folder) = (Arc::clone(self), folder.to_owned());
        // It is made to its end, also if nobody waits for it any more.
        let making = tokio::spawn(async move {
            let _turn = this.turn.lock().await;
            if let Some(made) = this.known().get(&folder).filter(|made| made.serves(state)) {
                return made.page.clone();
            }
            let (at, place) = (Instant::now(), folder.clone());
            let made = tokio::task::spawn_blocking(move || make(&place)).await;
            let page = made.unwrap_or_else(|error| Err(error.to_string()));
            let mut known = this.known();
            let oldest = known.iter().min_by_key(|(_, made)| made.at).map(|(folder, _)| folder.clone());
            if let Some(oldest) = oldest.filter(|_| known.len() >= MOST && !known.contains_key(&folder)) {
                known.remove(&oldest);
            }
            let took = at.elapsed();
            known.insert(folder, Made { state, page: page.clone(), at: Instant::now(), took });
            page
        });
        match tokio::time::timeout(PATIENCE, making).await {
            Ok(page) => page.unwrap_or_else(|error| Err(error.to_string())),
            Err(_) => Err("it is still being made; load this page again in a minute".into()),
        }
    }

    fn known(&self) -> MutexGuard<'_, HashMap<PathBuf, Made>> {
        self.made.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn make(folder: &Path) -> Result<Arc<str>, String> {
    let sources = Sources { folder: Some(Folder::new(folder)), ..Sources::default() };
    let page = sources.read(|whole: Whole<'_>| whole.page().map_err(ReportError::from));
    page.map(Arc::from).map_err(|error| error.to_string())
}
