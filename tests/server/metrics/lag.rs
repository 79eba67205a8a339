//! The metric of the transport thread's wake-up delay.

use super::{Watched, page::Page};
use crate::common::server::until;
use std::time::{Duration, Instant};

const LAG: &str = "perturb_transport_lag_seconds";
/// The interval at which the server measures the delay.
const TICK: Duration = Duration::from_millis(100);
/// The time for which the server is stopped.
const KEPT: Duration = Duration::from_millis(1200);
/// A bound of the histogram, s, that the measurement during the stop exceeds.
const BOUND: &str = "0.524288";

/// Stops all threads of the server for a while.
async fn keep_from_work(watched: &Watched) {
    watched.server.signal("STOP");
    let tasks = format!("/proc/{}/task", watched.server.child.id());
    until("every thread is stopped", async || {
        let mut stats = std::fs::read_dir(&tasks).unwrap().map(|task| task.unwrap().path().join("stat"));
        stats.all(|stat| std::fs::read_to_string(stat).is_ok_and(|stat| stat.contains(") T ")))
    })
    .await;
    tokio::time::sleep(KEPT).await;
    watched.server.signal("CONT");
}

#[tokio::test]
async fn lag_of_a_busy_transport_is_measured() {
    let start = Instant::now();
    let watched = Watched::start(&[]);
    let [count, sum, soon] =
        ["_count{", "_sum{", &format!("_bucket{{le=\"{BOUND}\",")].map(|part| format!("{LAG}{part}thread=\"0\"}}"));
    let late = |page: &Page| page.number(&count) - page.number(&soon);
    until("some looks are counted", async || watched.page().number(&count) > 2.0).await;
    let before = watched.page();
    assert!(before.tells(&soon) && before.number(&sum) > 0.0, "nobody wakes at once:\n{}", before.text);
    keep_from_work(&watched).await;
    until("a late look is counted", async || late(&watched.page()) > late(&before)).await;
    let page = watched.page();
    let (looks, sum, earlier) = (page.number(&count), page.number(&sum), before.number(&sum));
    assert!(sum - earlier > BOUND.parse::<f64>().unwrap(), "{sum} s after {earlier} s");
    // Measurements are made one after the other, so intervals and delays add up to at most the elapsed time.
    let most = start.elapsed().as_secs_f64() - TICK.as_secs_f64() * looks;
    assert!(sum < most, "{looks} looks were late by {sum} s in all, in {:?}", start.elapsed());
}
