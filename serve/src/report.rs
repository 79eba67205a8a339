//! The reports of experiments as they stand: made one at a time, kept while nothing changes, and made again so seldom that
//! trainings do not notice.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_study::Folder;
use perturb_study::report::{ReportError, Sources, Whole};
use tokio::sync::Semaphore;

/// So many are kept.
const MOST: usize = 16;
/// So many wait for one at a time; a browser asks again.
const MOST_WAITING: usize = 32;
/// After one another is begun after so many times as long as it took, whatever it is of.
const PAUSE: u32 = 2;
/// One is made again at the earliest after so long …
const LEAST: Duration = Duration::from_secs(5);
/// … and after so many times as long as it took.
const REST: u32 = 10;
/// So long somebody waits for one.
const PATIENCE: Duration = Duration::from_secs(60);
/// One that takes longer, as where a file system does not answer, no longer keeps others from being made.
const LONGEST: Duration = Duration::from_secs(120);
/// Said to those for whom it takes too long.
const STILL: &str = "it is still being made; load this page again in a minute";

/// What makes a report.
type Make = fn(&Path) -> Result<Arc<str>, String>;

/// Reports by the folders of their experiments.
#[derive(Debug)]
pub(crate) struct Reports {
    made: Mutex<HashMap<PathBuf, Made>>,
    /// Whoever has it makes one, not before this moment.
    turn: tokio::sync::Mutex<Instant>,
    waiting: Arc<Semaphore>,
    /// Whose reports take longer than [`LONGEST`].
    stuck: Mutex<HashSet<PathBuf>>,
    make: Make,
    longest: Duration,
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
    /// Whether it is as good as a new one, or too new to be made again. What kept one from being made may be gone.
    fn serves(&self, state: u64) -> bool {
        self.page.is_ok() && self.state == state || self.at.elapsed() < LEAST.max(self.took * REST)
    }
}

impl Default for Reports {
    fn default() -> Self {
        Self::by(make, LONGEST)
    }
}

impl Reports {
    fn by(make: Make, longest: Duration) -> Self {
        let (turn, waiting) = (tokio::sync::Mutex::new(Instant::now()), Arc::new(Semaphore::new(MOST_WAITING)));
        Self { made: Mutex::default(), turn, waiting, stuck: Mutex::default(), make, longest }
    }

    /// The state of which a report would be sent now: `state`, which the files have, or an earlier one.
    pub(crate) fn state(&self, folder: &Path, state: u64) -> u64 {
        self.known().get(folder).filter(|made| made.serves(state)).map_or(state, |made| made.state)
    }

    /// The page of the experiment in `folder`, whose files have this `state`; in its place what is wrong.
    pub(crate) async fn page(self: &Arc<Self>, folder: &Path, state: u64) -> Result<Arc<str>, String> {
        let (this, folder) = (Arc::clone(self), folder.to_owned());
        let Ok(place) = Arc::clone(&self.waiting).try_acquire_owned() else {
            return Err("too many wait for reports already".into());
        };
        // It is made to its end, also if nobody waits for it any more.
        let making = tokio::spawn(async move {
            let _place = place;
            let mut turn = this.turn.lock().await;
            if this.stuck().contains(&folder) {
                return Err(STILL.into());
            }
            if let Some(made) = this.known().get(&folder).filter(|made| made.serves(state)) {
                return made.page.clone();
            }
            tokio::time::sleep_until((*turn).into()).await;
            let (at, place, make) = (Instant::now(), folder.clone(), this.make);
            let mut making = tokio::task::spawn_blocking(move || make(&place));
            let made = match tokio::time::timeout(this.longest, &mut making).await {
                Ok(made) => {
                    *turn = Instant::now() + PAUSE * at.elapsed();
                    made
                }
                Err(_) => {
                    drop(turn);
                    this.stuck().insert(folder.clone());
                    let made = making.await;
                    this.stuck().remove(&folder);
                    made
                }
            };
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
            Err(_) => Err(STILL.into()),
        }
    }

    fn stuck(&self) -> MutexGuard<'_, HashSet<PathBuf>> {
        self.stuck.lock().unwrap_or_else(PoisonError::into_inner)
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

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use super::*;

    /// How many reports there were of folders of this name.
    static MADE: [AtomicUsize; 2] = [AtomicUsize::new(0), AtomicUsize::new(0)];

    fn made(name: &str) -> usize {
        MADE[usize::from(name == "bad")].load(Ordering::SeqCst)
    }

    fn counted(folder: &Path) -> Result<Arc<str>, String> {
        let bad = folder.ends_with("bad");
        let number = MADE[usize::from(bad)].fetch_add(1, Ordering::SeqCst);
        if bad { Err(format!("reason {number}")) } else { Ok(format!("{} {number}", folder.display()).into()) }
    }

    /// Makes it as old as if it had been made so long ago.
    fn age(reports: &Reports, folder: &Path, by: Duration) {
        let mut known = reports.known();
        let made = known.get_mut(folder).unwrap();
        made.at = made.at.checked_sub(by).unwrap();
    }

    #[tokio::test]
    async fn a_report_is_made_again_when_it_is_another_one_and_not_too_often() {
        let (reports, good, bad) = (Arc::new(Reports::by(counted, LONGEST)), Path::new("good"), Path::new("bad"));
        let first = reports.page(good, 1).await.unwrap();
        assert_eq!(reports.page(good, 1).await.unwrap(), first);
        assert_eq!(reports.page(good, 2).await.unwrap(), first, "too early");
        assert_eq!((reports.state(good, 2), reports.state(bad, 2)), (1, 2));
        age(&reports, good, LEAST);
        assert_eq!(reports.page(good, 1).await.unwrap(), first, "nothing has changed");
        assert_eq!(reports.state(good, 2), 2);
        assert_ne!(reports.page(good, 2).await.unwrap(), first);
        assert_eq!(made("good"), 2);

        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 0");
        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 0", "too early");
        age(&reports, bad, LEAST);
        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 1", "what was wrong may have been put right");
    }

    fn slow(folder: &Path) -> Result<Arc<str>, String> {
        std::thread::sleep(Duration::from_millis(50));
        Ok(folder.display().to_string().into())
    }

    #[tokio::test]
    async fn however_many_experiments_there_are_some_reports_are_kept_and_between_two_is_a_rest() {
        let (reports, begun) = (Arc::new(Reports::by(slow, LONGEST)), Instant::now());
        for number in 0..=MOST {
            reports.page(&PathBuf::from(number.to_string()), 1).await.unwrap();
        }
        assert!(begun.elapsed() >= Duration::from_millis(50) * (1 + (1 + PAUSE) * MOST as u32));
        let known = reports.known();
        assert_eq!((known.len(), known.contains_key(Path::new("0"))), (MOST, false), "the oldest has gone");
    }

    #[tokio::test]
    async fn so_many_wait_and_no_more() {
        let reports = Arc::new(Reports::by(slow, LONGEST));
        let ask = |number: usize| {
            let reports = Arc::clone(&reports);
            async move { reports.page(&PathBuf::from((number % 2).to_string()), 1).await }
        };
        let answers = futures_util::future::join_all((0..=MOST_WAITING).map(ask)).await;
        let refused: Vec<_> = answers.into_iter().filter_map(Result::err).collect();
        assert_eq!(refused, ["too many wait for reports already"]);
    }

    /// Whether reports of folders of this name hang.
    static HANGS: AtomicBool = AtomicBool::new(true);

    fn hanging(folder: &Path) -> Result<Arc<str>, String> {
        while folder.ends_with("hangs") && HANGS.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(folder.display().to_string().into())
    }

    #[tokio::test]
    async fn one_that_hangs_keeps_no_other_from_being_made() {
        let reports = Arc::new(Reports::by(hanging, Duration::from_millis(50)));
        let ask = |name: &'static str| {
            let reports = Arc::clone(&reports);
            tokio::spawn(async move { reports.page(Path::new(name), 1).await })
        };
        let stuck = ask("hangs");
        while reports.stuck().is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(ask("other").await.unwrap().as_deref(), Ok("other"));
        assert_eq!(ask("hangs").await.unwrap(), Err(STILL.into()), "it is not begun a second time");
        HANGS.store(false, Ordering::Relaxed);
        assert_eq!(stuck.await.unwrap().as_deref(), Ok("hangs"));
        assert!(reports.stuck().is_empty());
    }
}
