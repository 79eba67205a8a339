//! A cache of the reports of experiments and assessments. It builds one report at a time, with pauses that leave the
//! processor to trainings.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use perturb_experiment::ExperimentFolder;
use perturb_experiment::runs::RunKind;
use perturb_report::{ReportBundle, ReportError, ReportInputs};
use tokio::sync::Semaphore;

/// Maximum number of cached reports.
const MAX_REPORTS: usize = 16;
/// Maximum number of requests that wait for reports at the same time. Further requests are refused, and browsers repeat
/// them.
const MAX_WAITING: usize = 32;
/// Pause between two builds, also of different reports, as a multiple of the last build's duration.
const BUILD_PAUSE_FACTOR: u32 = 2;
/// Minimum time between two builds of the same report.
const MIN_REBUILD_INTERVAL: Duration = Duration::from_secs(5);
/// Time between two builds of the same report, as a multiple of the last build's duration.
const REBUILD_INTERVAL_FACTOR: u32 = 10;
/// Maximum time for which a request waits for a report.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(60);
/// Time after which other reports no longer wait for a build. The build may hang, e.g. in a file system that does not
/// answer.
const BUILD_TIMEOUT: Duration = Duration::from_secs(120);
/// Message for requests that have waited too long.
const STILL_BUILDING: &str = "it is still being built; load this page again in a minute";

/// A function that builds the report of a folder as HTML. Its error is a text with the reason.
type BuildReport = fn(&Path) -> Result<Arc<str>, String>;

/// A cache of reports, by their folders.
#[derive(Debug)]
pub(crate) struct ReportCache {
    reports: Mutex<HashMap<PathBuf, CachedReport>>,
    /// Earliest start of the next build. A task must hold this lock while it builds.
    next_build: tokio::sync::Mutex<Instant>,
    waiting: Arc<Semaphore>,
    /// Folders of running builds that have exceeded the build timeout.
    overdue: Mutex<HashSet<PathBuf>>,
    build: BuildReport,
    build_timeout: Duration,
}

/// The result of a build: a report, or the reason why it could not be built.
#[derive(Clone, Debug)]
struct CachedReport {
    /// Fingerprint of the files from which the report was built.
    fingerprint: u64,
    page: Result<Arc<str>, String>,
    /// Time at which the build ended.
    at: Instant,
    build_time: Duration,
}

impl CachedReport {
    /// Tells whether the report is up to date, or too recent to be built again. A failed build is never up to date,
    /// because a second attempt may succeed with the same files.
    fn is_usable(&self, fingerprint: u64) -> bool {
        let interval = MIN_REBUILD_INTERVAL.max(self.build_time * REBUILD_INTERVAL_FACTOR);
        self.page.is_ok() && self.fingerprint == fingerprint || self.at.elapsed() < interval
    }
}

impl Default for ReportCache {
    fn default() -> Self {
        Self::new(build, BUILD_TIMEOUT)
    }
}

impl ReportCache {
    fn new(build: BuildReport, build_timeout: Duration) -> Self {
        Self {
            reports: Mutex::default(),
            next_build: tokio::sync::Mutex::new(Instant::now()),
            waiting: Arc::new(Semaphore::new(MAX_WAITING)),
            overdue: Mutex::default(),
            build,
            build_timeout,
        }
    }

    /// Returns the fingerprint of the report that a request would get now. `fingerprint` is the fingerprint of the
    /// present files. The result is an earlier fingerprint if the cached report is too recent to be built again.
    pub(crate) fn fingerprint(&self, folder: &Path, fingerprint: u64) -> u64 {
        let reports = self.reports();
        reports
            .get(folder)
            .filter(|report| report.is_usable(fingerprint))
            .map_or(fingerprint, |report| report.fingerprint)
    }

    /// Returns the report of the experiment or assessment in `folder` as HTML. Builds the report if the cache has no
    /// usable one. `fingerprint` is the fingerprint of the present files.
    ///
    /// # Errors
    /// A text with the reason why there is no report.
    pub(crate) async fn page(self: &Arc<Self>, folder: &Path, fingerprint: u64) -> Result<Arc<str>, String> {
        let this = Arc::clone(self);
        let folder = folder.to_owned();
        let Ok(permit) = Arc::clone(&self.waiting).try_acquire_owned() else {
            return Err("too many requests wait for reports already".into());
        };
        // The build is a separate task, so that it continues even if the request is given up.
        let task = tokio::spawn(async move {
            let _permit = permit;
            // Only the task with this lock may build. While this task waited for the lock, another task may have built
            // the report.
            let mut next_build = this.next_build.lock().await;
            if this.overdue().contains(&folder) {
                return Err(STILL_BUILDING.into());
            }
            if let Some(report) = this.reports().get(&folder).filter(|report| report.is_usable(fingerprint)) {
                return report.page.clone();
            }
            tokio::time::sleep_until((*next_build).into()).await;
            let start = Instant::now();
            let built_folder = folder.clone();
            let build = this.build;
            let mut building = tokio::task::spawn_blocking(move || build(&built_folder));
            let built = match tokio::time::timeout(this.build_timeout, &mut building).await {
                Ok(built) => {
                    *next_build = Instant::now() + BUILD_PAUSE_FACTOR * start.elapsed();
                    built
                }
                Err(_) => {
                    drop(next_build);
                    this.overdue().insert(folder.clone());
                    let built = building.await;
                    this.overdue().remove(&folder);
                    built
                }
            };
            let page = built.unwrap_or_else(|error| Err(error.to_string()));
            let build_time = start.elapsed();
            this.insert(folder, CachedReport { fingerprint, page: page.clone(), at: Instant::now(), build_time });
            page
        });
        match tokio::time::timeout(REQUEST_TIMEOUT, task).await {
            Ok(page) => page.unwrap_or_else(|error| Err(error.to_string())),
            Err(_) => Err(STILL_BUILDING.into()),
        }
    }

    /// Adds a report to the cache. If there are more than [`MAX_REPORTS`], drops the oldest report.
    fn insert(&self, folder: PathBuf, report: CachedReport) {
        let mut reports = self.reports();
        let oldest = reports.iter().min_by_key(|(_, report)| report.at).map(|(folder, _)| folder.clone());
        if let Some(oldest) = oldest.filter(|_| reports.len() >= MAX_REPORTS && !reports.contains_key(&folder)) {
            reports.remove(&oldest);
        }
        reports.insert(folder, report);
    }

    fn overdue(&self) -> MutexGuard<'_, HashSet<PathBuf>> {
        self.overdue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn reports(&self) -> MutexGuard<'_, HashMap<PathBuf, CachedReport>> {
        self.reports.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn build(folder: &Path) -> Result<Arc<str>, String> {
    let mut inputs = ReportInputs::default();
    match RunKind::detect(folder) {
        Some(RunKind::Experiment) => inputs.folder = Some(ExperimentFolder::new(folder)),
        _ => inputs.add(folder).map_err(|error| error.to_string())?,
    }
    let page = inputs.read(|whole: ReportBundle<'_>| whole.page().map_err(ReportError::from));
    page.map(Arc::from).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    use super::*;

    /// Numbers of builds: of folders that are not called `bad` (0), and of folders called `bad` (1).
    static BUILT: [AtomicUsize; 2] = [AtomicUsize::new(0), AtomicUsize::new(0)];

    fn built(name: &str) -> usize {
        BUILT[usize::from(name == "bad")].load(Ordering::SeqCst)
    }

    fn build_and_count(folder: &Path) -> Result<Arc<str>, String> {
        let bad = folder.ends_with("bad");
        let number = BUILT[usize::from(bad)].fetch_add(1, Ordering::SeqCst);
        if bad { Err(format!("reason {number}")) } else { Ok(format!("{} {number}", folder.display()).into()) }
    }

    /// Makes a report older.
    fn age(cache: &ReportCache, folder: &Path, by: Duration) {
        let mut reports = cache.reports();
        let report = reports.get_mut(folder).unwrap();
        report.at = report.at.checked_sub(by).unwrap();
    }

    #[tokio::test]
    async fn changed_reports_are_built_again_but_not_too_often() {
        let (reports, good, bad) =
            (Arc::new(ReportCache::new(build_and_count, BUILD_TIMEOUT)), Path::new("good"), Path::new("bad"));
        let first = reports.page(good, 1).await.unwrap();
        assert_eq!(reports.page(good, 1).await.unwrap(), first);
        assert_eq!(reports.page(good, 2).await.unwrap(), first, "too early");
        assert_eq!((reports.fingerprint(good, 2), reports.fingerprint(bad, 2)), (1, 2));
        age(&reports, good, MIN_REBUILD_INTERVAL);
        assert_eq!(reports.page(good, 1).await.unwrap(), first, "nothing has changed");
        assert_eq!(reports.fingerprint(good, 2), 2);
        assert_ne!(reports.page(good, 2).await.unwrap(), first);
        assert_eq!(built("good"), 2);

        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 0");
        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 0", "too early");
        age(&reports, bad, MIN_REBUILD_INTERVAL);
        assert_eq!(reports.page(bad, 1).await.unwrap_err(), "reason 1", "the cause may be gone");
    }

    fn slow(folder: &Path) -> Result<Arc<str>, String> {
        std::thread::sleep(Duration::from_millis(50));
        Ok(folder.display().to_string().into())
    }

    #[tokio::test]
    async fn the_oldest_report_is_dropped_and_builds_have_pauses() {
        let cache = Arc::new(ReportCache::new(slow, BUILD_TIMEOUT));
        let start = Instant::now();
        for number in 0..=MAX_REPORTS {
            cache.page(&PathBuf::from(number.to_string()), 1).await.unwrap();
        }
        assert!(start.elapsed() >= Duration::from_millis(50) * (1 + (1 + BUILD_PAUSE_FACTOR) * MAX_REPORTS as u32));
        let reports = cache.reports();
        assert_eq!((reports.len(), reports.contains_key(Path::new("0"))), (MAX_REPORTS, false));
    }

    #[tokio::test]
    async fn too_many_waiting_requests_are_refused() {
        let reports = Arc::new(ReportCache::new(slow, BUILD_TIMEOUT));
        let ask = |number: usize| {
            let reports = Arc::clone(&reports);
            async move { reports.page(&PathBuf::from((number % 2).to_string()), 1).await }
        };
        let answers = futures_util::future::join_all((0..=MAX_WAITING).map(ask)).await;
        let refused: Vec<_> = answers.into_iter().filter_map(Result::err).collect();
        assert_eq!(refused, ["too many requests wait for reports already"]);
    }

    /// While this is true, builds of folders called `hangs` do not end.
    static HANGS: AtomicBool = AtomicBool::new(true);

    fn hanging(folder: &Path) -> Result<Arc<str>, String> {
        while folder.ends_with("hangs") && HANGS.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(folder.display().to_string().into())
    }

    #[tokio::test]
    async fn a_hanging_build_delays_no_other_report() {
        let reports = Arc::new(ReportCache::new(hanging, Duration::from_millis(50)));
        let ask = |name: &'static str| {
            let reports = Arc::clone(&reports);
            tokio::spawn(async move { reports.page(Path::new(name), 1).await })
        };
        let hanging = ask("hangs");
        while reports.overdue().is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        assert_eq!(ask("other").await.unwrap().as_deref(), Ok("other"));
        assert_eq!(ask("hangs").await.unwrap(), Err(STILL_BUILDING.into()), "it is not begun a second time");
        HANGS.store(false, Ordering::Relaxed);
        assert_eq!(hanging.await.unwrap().as_deref(), Ok("hangs"));
        assert!(reports.overdue().is_empty());
    }
}
