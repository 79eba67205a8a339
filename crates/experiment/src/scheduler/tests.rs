//! Tests of the scheduler, with a simulated clock and a backend that follows a script.

use rstest::rstest;
use tempfile::TempDir;

use super::*;

/// A plan with four cells.
const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
    [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

/// An action of an attempt in a script. `Wait` takes the given number of simulated seconds, every other action one.
#[derive(Clone, Debug)]
enum Act {
    Say(CellEvent),
    Wait(u64),
    /// The cell's result is written.
    Result,
    /// A failure of the cell is written.
    Failure,
    End(CellEvent),
    /// The backend hands the cell back without starting it.
    Return,
}
use Act::{Failure as Fails, Result as Succeeds, Return, Say, Wait};

fn ends(end: CellEvent) -> Act {
    Act::End(end)
}

fn killed() -> Act {
    ends(CellEvent::Killed { reason: "signal 9".into() })
}

fn lost() -> Act {
    ends(CellEvent::LostServer { reason: "gone".into() })
}

fn server() -> Act {
    Say(CellEvent::Server { address: "unix:/x".into() })
}

fn saved(saved: u64) -> Act {
    Say(CellEvent::Training { episodes: 1, timesteps: saved + 5, saved })
}

fn done() -> Vec<Act> {
    vec![Succeeds, ends(CellEvent::Done)]
}

/// A backend that follows a script. `script` gets a cell and the number of the attempt at the cell, from 1, and returns
/// the actions of this attempt. With `RECORDS_CRASHES`, the scheduler records a cell as failed whose process crashed too
/// often, and expects the backend to report the end of each started cell, as with [`Local`]. Otherwise it does neither,
/// as with jobs of a cluster.
struct Fake<'a, const RECORDS_CRASHES: bool> {
    place: &'a Place,
    script: &'a dyn Fn(usize, usize) -> Vec<Act>,
    grouping: Grouping,
    start: Instant,
    now: Instant,
    /// The running groups: each cell with its remaining actions.
    running: Vec<Vec<(usize, VecDeque<Act>)>>,
    /// For each attempt: the cell, the start time in seconds, and the number of servers that the cell had lost before.
    begun: Vec<(usize, u64, usize)>,
    groups: Vec<Vec<usize>>,
    most_at_a_time: usize,
}

impl<const RECORDS_CRASHES: bool> Backend for Fake<'_, RECORDS_CRASHES> {
    fn grouping(&self) -> Grouping {
        self.grouping
    }

    fn records_crashes_as_failures(&self) -> bool {
        RECORDS_CRASHES
    }

    fn reports_ends(&self) -> bool {
        RECORDS_CRASHES
    }

    fn poll(&mut self, now: Instant) -> Result<Vec<BackendEvent>> {
        self.now = now;
        let mut events = Vec::new();
        let place = self.place;
        for group in &mut self.running {
            group.retain_mut(|(cell, acts)| {
                match acts.pop_front() {
                    Some(Say(event) | Act::End(event)) => events.push(BackendEvent::Event(*cell, event)),
                    Some(Wait(seconds)) if seconds > 1 => acts.push_front(Wait(seconds - 1)),
                    Some(Wait(_)) => {}
                    Some(Succeeds) => place.write(*cell, "result.json"),
                    Some(Fails) => place.fail(*cell),
                    Some(Return) => events.push(BackendEvent::Returned(*cell)),
                    None => panic!("an attempt at cell {cell} has no end"),
                }
                !acts.is_empty()
            });
        }
        self.running.retain(|group| !group.is_empty());
        Ok(events)
    }

    fn free_slots(&self) -> usize {
        self.grouping.at_a_time - self.running.len()
    }

    fn begin(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>> {
        for group in groups {
            let mut running = Vec::new();
            for offer in group {
                // Clears the failure, as a real worker does.
                if let Some(failure) = offer.retry {
                    self.place.folder.cell(self.place.id(offer.cell)).clear_failure_if(failure).unwrap();
                }
                self.begun.push((offer.cell, (self.now - self.start).as_secs(), offer.lost_servers));
                let attempt = self.begun.iter().filter(|(cell, ..)| *cell == offer.cell).count();
                running.push((offer.cell, (self.script)(offer.cell, attempt).into()));
            }
            self.running.push(running);
            self.groups.push(group.iter().map(|offer| offer.cell).collect());
        }
        self.most_at_a_time = self.most_at_a_time.max(self.running.len());
        Ok(groups.iter().flatten().map(|offer| offer.cell).collect())
    }

    fn load(&self) -> (String, usize) {
        (format!("{} running", self.running.len()), self.grouping.at_a_time)
    }

    fn stop(&mut self) -> Vec<String> {
        Vec::new()
    }
}

/// A plan with a temporary folder.
struct Place {
    _directory: TempDir,
    folder: ExperimentFolder,
    plan: Plan,
}

/// The result of a run, with everything that it reported.
#[derive(Debug)]
struct Ran {
    end: Result<Vec<String>, String>,
    begun: Vec<(usize, u64, usize)>,
    groups: Vec<Vec<usize>>,
    most_at_a_time: usize,
    notes: Vec<String>,
    statuses: Vec<RunStatus>,
    /// The ids of the cells that were reported as done.
    told: Vec<String>,
}

impl Ran {
    /// Returns the number of attempts at each of the four cells.
    fn attempts(&self) -> Vec<usize> {
        (0..4).map(|cell| self.begun.iter().filter(|(begun, ..)| *begun == cell).count()).collect()
    }

    /// Returns the times at which cell 0 was started, in seconds.
    fn times(&self) -> Vec<u64> {
        self.begun.iter().filter(|(cell, ..)| *cell == 0).map(|(_, time, _)| *time).collect()
    }
}

impl Place {
    fn new() -> Self {
        Self::of(PLAN)
    }

    fn of(plan: &str) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        Self { _directory: directory, folder, plan: Plan::parse("test", plan.into()).unwrap() }
    }

    fn id(&self, cell: usize) -> &str {
        &self.plan.cells[cell].id
    }

    fn write(&self, cell: usize, name: &str) {
        let path = self.folder.cell(self.id(cell)).path().to_owned();
        std::fs::create_dir_all(&path).unwrap();
        std::fs::write(path.join(name), "x").unwrap();
    }

    fn fail(&self, cell: usize) {
        let failure = FailureRecord {
            id: self.id(cell).to_owned(),
            reason: "NaN".into(),
            commit: "x".into(),
            requires_restart: true,
        };
        self.folder.cell(self.id(cell)).write_failure(&failure).unwrap();
    }

    fn failure(&self, cell: usize) -> String {
        std::fs::read_to_string(self.folder.cell(self.id(cell)).path().join("failure.json")).unwrap_or_default()
    }

    fn finished(&self, failed: &[usize]) -> Result<Vec<String>, String> {
        Ok(failed.iter().map(|&cell| self.id(cell).to_owned()).collect())
    }

    /// Runs the plan to its end, one cell at a time.
    fn run(&self, script: &dyn Fn(usize, usize) -> Vec<Act>) -> Ran {
        self.run_on::<true>(1, false, script)
    }

    fn run_on<const RECORDS_CRASHES: bool>(
        &self,
        jobs: usize,
        retry_failed: bool,
        script: &dyn Fn(usize, usize) -> Vec<Act>,
    ) -> Ran {
        self.run_in::<RECORDS_CRASHES>(Grouping { max_cells: 1, at_a_time: jobs }, retry_failed, script)
    }

    /// Runs the plan to its end, in groups.
    fn run_in<const RECORDS_CRASHES: bool>(
        &self,
        grouping: Grouping,
        retry_failed: bool,
        script: &dyn Fn(usize, usize) -> Vec<Act>,
    ) -> Ran {
        let start = Instant::now();
        let (begun, groups, running) = (Vec::new(), Vec::new(), Vec::new());
        let (now, most_at_a_time) = (start, 0);
        let mut fake = Fake::<RECORDS_CRASHES> {
            place: self,
            script,
            grouping,
            start,
            now,
            running,
            begun,
            groups,
            most_at_a_time,
        };
        let (mut notes, mut statuses, mut told) = (Vec::new(), Vec::new(), Vec::new());
        let mut report = |report: ProgressEvent<'_>| match report {
            ProgressEvent::Status(status) => statuses.push(status.clone()),
            ProgressEvent::Note(note) => notes.push(note.to_owned()),
            ProgressEvent::Line(line) if line.event == CellEvent::Done => told.push(line.cell.clone()),
            ProgressEvent::Line(_) => {}
        };
        let retryable = if retry_failed { self.folder.failures().unwrap() } else { HashMap::new() };
        let mut scheduler = Scheduler::new(&self.plan, &self.folder, &mut fake, &retryable, &mut report);
        let end = (0..10_000).find_map(|second| scheduler.step(start + Duration::from_secs(second)).transpose());
        let end = end.expect("it ends").map_err(|error| error.to_string());
        let Fake { begun, groups, most_at_a_time, .. } = fake;
        Ran { end, begun, groups, most_at_a_time, notes, statuses, told }
    }
}

#[test]
fn every_cell_is_done_once_and_a_second_run_does_nothing() {
    let place = Place::new();
    for (run, attempts) in [[1, 1, 1, 1], [0, 0, 0, 0]].into_iter().enumerate() {
        let ran = place.run_on::<true>(3, false, &|_, _| done());
        assert_eq!(ran.end, place.finished(&[]));
        assert_eq!(ran.attempts(), attempts, "run {}", run + 1);
        assert!(ran.most_at_a_time <= 3);
    }
}

#[rstest]
#[case::killed(vec![killed()], 3, "signal 9; 3 attempts in a row made no progress")]
#[case::stopped_alone(vec![ends(CellEvent::Stopped { signal: 15 })], 3, "signal 15 ended its process; 3 attempts")]
#[case::failed_unrecorded(vec![ends(CellEvent::Failed { reason: "disk full".into() })], 1, "disk full")]
#[case::failed(vec![Fails, ends(CellEvent::Failed { reason: "NaN".into() })], 1, "NaN")]
#[case::done_without_a_result(vec![ends(CellEvent::Done)], 3, "done; 3 attempts in a row")]
fn a_cell_that_ends_like_this_has_failed_after(
    #[case] acts: Vec<Act>,
    #[case] attempts: usize,
    #[case] recorded: &str,
) {
    let place = Place::new();
    let ran = place.run(&|cell, _| if cell == 1 { acts.clone() } else { done() });
    assert_eq!(ran.end, place.finished(&[1]));
    assert_eq!(ran.attempts(), [1, attempts, 1, 1]);
    assert!(place.failure(1).contains(recorded), "{}", place.failure(1));
}

#[test]
fn an_attempt_that_ended_in_a_checkpoint_does_not_count() {
    let place = Place::new();
    let script = |cell, attempt| match (cell, attempt) {
        (0, 1..=5) => vec![server(), saved(100 * attempt as u64), killed()],
        (0, 6..=7) => vec![saved(500), killed()],
        _ => done(),
    };
    let ran = place.run(&script);
    assert_eq!(ran.end, place.finished(&[0]));
    assert_eq!(ran.attempts(), [7, 1, 1, 1]);
}

#[test]
fn a_killed_cell_waits_until_the_others_had_their_turn() {
    let place = Place::new();
    let ran = place.run(&|cell, attempt| if cell == 0 && attempt < 3 { vec![killed()] } else { done() });
    assert_eq!(ran.begun.iter().map(|(cell, ..)| *cell).collect::<Vec<_>>(), [0, 1, 2, 3, 0, 0]);
    assert_eq!(ran.end, place.finished(&[]));
}

#[test]
fn server_waits_double_and_end() {
    let place = Place::new();
    let ran = place.run(&|_, _| vec![lost()]);
    let message = format!("the run cannot continue without a server: {}: gone; finished work is kept", place.id(0));
    assert!(ran.end.as_ref().is_err_and(|error| error.starts_with(&message)), "{:?}", ran.end);
    // Each loss is reported one second after the start. The pauses are 1, 2, 4 and 8 s.
    assert_eq!(ran.times(), [0, 2, 5, 10, 19], "at the front of the queue");
    assert_eq!(ran.attempts(), [5, 0, 0, 0]);
    assert_eq!(ran.begun.iter().map(|(.., lost)| *lost).collect::<Vec<_>>(), [0, 1, 2, 3, 4], "the losses so far");
    assert!((0..4).all(|cell| !place.folder.cell(place.id(cell)).is_settled(true)), "no cell is blamed");
}

#[test]
fn full_disk_ends_the_run_without_a_failed_cell() {
    let place = Place::new();
    let full = || ends(CellEvent::FileFault { reason: "no space left".into() });
    let ran = place.run(&|cell, attempt| if cell == 0 && attempt < 5 { vec![full()] } else { done() });
    assert_eq!((ran.end.clone(), ran.attempts()), (place.finished(&[]), vec![5, 1, 1, 1]), "there is room again");
    let place = Place::new();
    let ran = place.run(&|_, _| vec![server(), Wait(90), full()]);
    let message = format!("the run cannot continue: {}: no space left; fix this, and resume", place.id(0));
    assert!(ran.end.as_ref().is_err_and(|error| error.starts_with(&message)), "{:?}", ran.end);
    assert!((0..4).all(|cell| !place.folder.cell(place.id(cell)).is_settled(true)), "no cell is blamed");
    // Lost servers and file faults are counted separately.
    let place = Place::new();
    let ran = place.run(&|cell, attempt| match (cell, attempt) {
        (0, 1..=4) => vec![lost()],
        (0, 5..=6) => vec![full()],
        _ => done(),
    });
    assert_eq!(ran.end, place.finished(&[]));
    // A cell that makes progress in each attempt may be retried without a limit.
    let place = Place::new();
    let ran = place.run(&|cell, attempt| match (cell, attempt) {
        (0, 1..=7) => vec![saved(100 * attempt as u64), saved(100 * attempt as u64 + 50), full()],
        _ => done(),
    });
    assert_eq!(ran.end, place.finished(&[]));
}

#[rstest]
#[case::had_one_for_a_minute(vec![server(), Wait(60), lost()], true)]
#[case::had_one_for_less(vec![server(), Wait(50), lost()], false)]
#[case::only_looked_for_one(vec![Wait(300), lost()], false)]
fn a_loss_after_a_minute_with_a_server_is_counted_from_one(#[case] fifth: Vec<Act>, #[case] goes_on: bool) {
    let place = Place::new();
    let ran = place.run(&|_, attempt| match attempt {
        1..=4 => vec![lost()],
        5 => fifth.clone(),
        6..=8 => vec![lost()],
        _ => done(),
    });
    assert_eq!(ran.end.is_ok(), goes_on, "{:?}", ran.end);
}

#[test]
fn an_earlier_failure_counts_unless_it_is_retried() {
    let place = Place::new();
    place.fail(2);
    assert_eq!(place.run(&|_, _| done()).end, place.finished(&[2]));
    // The old failure does not count, even if the first new attempt loses its server.
    let ran = place.run_on::<true>(1, true, &|_, attempt| if attempt == 1 { vec![lost()] } else { done() });
    assert_eq!((ran.end, ran.begun.len()), (place.finished(&[]), 2));
}

#[test]
fn a_failure_that_another_run_records_meanwhile_counts() {
    let place = Place::new();
    place.fail(2);
    // While cell 0 runs, another run retries cell 2, which fails again.
    let script = |cell, _| {
        if cell == 0 {
            place.folder.cell(place.id(2)).clear_failure().unwrap();
            place.fail(2);
        }
        done()
    };
    let ran = place.run_on::<true>(1, true, &script);
    assert_eq!(ran.end, place.finished(&[2]));
    assert_eq!(ran.attempts(), [1, 1, 0, 1], "it is not tried once more");
}

#[test]
fn a_cell_that_others_work_on_is_waited_for_and_taken_over() {
    let place = Place::new();
    let lock = std::cell::Cell::new(place.folder.cell(place.id(1)).try_lock().unwrap());
    let script = |cell, attempt| match (cell, attempt) {
        (1, 1) => vec![ends(CellEvent::Busy)],
        (3, 1) => {
            // Another process releases cell 1 while cell 3 runs.
            drop(lock.take());
            vec![Wait(30), Succeeds, ends(CellEvent::Done)]
        }
        _ => done(),
    };
    let ran = place.run(&script);
    assert_eq!(ran.end, place.finished(&[]));
    assert_eq!(ran.begun.iter().map(|(cell, ..)| *cell).collect::<Vec<_>>(), [0, 1, 2, 3, 1]);
}

#[test]
fn results_of_other_runs_are_seen_at_once_and_not_repeated() {
    let place = Place::new();
    let script = |cell, _| {
        if cell == 0 {
            (1..4).for_each(|cell| place.write(cell, "result.json"));
            return vec![Wait(5), Succeeds, ends(CellEvent::Done)];
        }
        panic!("cell {cell} is done")
    };
    let ran = place.run(&script);
    assert_eq!(ran.end, place.finished(&[]));
    assert_eq!(ran.statuses[1].done, 3);
}

#[test]
fn a_run_does_not_end_before_its_last_cell_is_reported_as_done() {
    let place = Place::new();
    let ran = place.run(&|_, _| vec![server(), Succeeds, Wait(5), ends(CellEvent::Done)]);
    assert_eq!(ran.end, place.finished(&[]));
    assert_eq!(ran.told, [0, 1, 2, 3].map(|cell| place.id(cell)));
}

#[test]
fn a_run_whose_jobs_do_not_report_their_ends_sees_the_results() {
    let place = Place::new();
    let ran = place.run_on::<false>(4, false, &|_, _| vec![server(), Succeeds, Wait(9_000), ends(CellEvent::Done)]);
    assert_eq!(ran.end, place.finished(&[]));
    assert_eq!(ran.attempts(), [1, 1, 1, 1]);
    assert!(ran.told.is_empty(), "{:?}", ran.told);
}

#[test]
fn a_refused_job_ends_the_run() {
    let place = Place::new();
    let ran = place.run(&|_, _| vec![ends(CellEvent::Refused { reason: "no such cell".into() })]);
    assert!(ran.end.is_err_and(|error| error.starts_with("a worker refused its job: no such cell; did another run")));
}

#[test]
fn cell_is_given_up_if_machines_may_be_faulty() {
    let place = Place::new();
    let ran = place.run_on::<false>(2, false, &|cell, _| if cell == 1 { vec![killed()] } else { done() });
    let message = format!("1 cell without a result after 3 attempts; the first is {}: signal 9; fix", place.id(1));
    assert!(ran.end.as_ref().is_err_and(|error| error.starts_with(&message)), "{:?}", ran.end);
    assert_eq!(ran.attempts(), [1, 3, 1, 1]);
    assert_eq!(place.failure(1), "", "nothing is recorded");
    let note = format!("{} is given up: 3 attempts made no progress", place.id(1));
    assert_eq!(ran.notes, [note]);
}

#[test]
fn handing_a_cell_back_is_no_failed_attempt() {
    let place = Place::new();
    let ran = place.run(&|cell, attempt| if cell == 0 && attempt < 9 { vec![Return] } else { done() });
    assert_eq!((ran.attempts(), ran.end), (vec![9, 1, 1, 1], place.finished(&[])));
}

#[test]
fn the_status_says_what_is_done_with_each_cell() {
    let place = Place::new();
    place.fail(3);
    let script = |cell, _| match cell {
        0 => done(),
        _ => vec![server(), saved(7), Wait(2), Succeeds, ends(CellEvent::Done)],
    };
    let ran = place.run_on::<true>(2, false, &script);
    let status = &ran.statuses[4];
    assert_eq!((status.cells, status.done, status.failed), (4, 1, 1));
    assert_eq!(status.doing, "2 running");
    let running: Vec<String> = status.running.iter().map(ToString::to_string).collect();
    assert_eq!(running, [1, 2].map(|cell| format!("{}: 1 episode of training", place.id(cell))));
}

/// A plan with six cells of one kind.
const GROUPS: &str = "environments = ['CartPole']\nversions = ['D']\nruns = 6
    [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
/// Groups of three cells, one group at a time.
const THREES: Grouping = Grouping { max_cells: 3, at_a_time: 1 };

#[test]
fn group_begins_together_and_settles_singly() {
    let place = Place::of(GROUPS);
    let script = |cell, _| match cell {
        1 => vec![Fails, ends(CellEvent::Failed { reason: "NaN".into() })],
        2 => vec![server(), saved(7), Wait(5), Succeeds, ends(CellEvent::Done)],
        _ => done(),
    };
    let ran = place.run_in::<true>(THREES, false, &script);
    assert_eq!(ran.groups, [vec![0, 1, 2], vec![3, 4, 5]]);
    assert_eq!(
        ran.begun.iter().map(|(_, time, _)| *time).collect::<Vec<_>>(),
        [0, 0, 0, 9, 9, 9],
        "when all have ended"
    );
    assert_eq!(ran.end, place.finished(&[1]));
    let status = &ran.statuses[3];
    assert_eq!((status.done, status.failed, status.running.len()), (1, 1, 1));
}

#[test]
fn unfinished_cells_are_grouped_without_finished_ones() {
    let place = Place::of(GROUPS);
    [0, 1, 4].iter().for_each(|&cell| place.write(cell, "result.json"));
    assert_eq!(place.run_in::<true>(THREES, false, &|_, _| done()).groups, [vec![2, 3, 5]]);
}

#[test]
fn a_cell_that_kills_its_process_is_the_only_one_that_fails() {
    let place = Place::of(GROUPS);
    // No cell made progress, so it is unknown which cell killed the process.
    let script = |cell, attempt| if cell == 1 || (cell < 3 && attempt == 1) { vec![killed()] } else { done() };
    let ran = place.run_in::<true>(THREES, false, &script);
    assert_eq!(ran.groups, [vec![0, 1, 2], vec![3, 4, 5], vec![0], vec![1], vec![2], vec![1]]);
    assert_eq!(ran.end, place.finished(&[1]));
}

#[test]
fn interrupted_cells_with_progress_stay_together() {
    let place = Place::of(GROUPS);
    let script = |cell, attempt| match (cell, attempt) {
        (0 | 2, 1) => vec![saved(0), saved(50), killed()],
        (1, 1) => vec![saved(40), Wait(1), killed()], // no progress since the start of the attempt
        _ => done(),
    };
    let ran = place.run_in::<true>(THREES, false, &script);
    assert_eq!(ran.groups, [vec![0, 1, 2], vec![3, 4, 5], vec![0, 2], vec![1]]);
    assert_eq!(ran.end, place.finished(&[]));
}

#[test]
fn a_server_that_a_group_loses_is_one_loss() {
    let place = Place::of(GROUPS);
    let ran = place.run_in::<true>(Grouping { max_cells: 6, at_a_time: 1 }, false, &|_, attempt| match attempt {
        1..=4 => vec![lost()],
        _ => done(),
    });
    assert_eq!(ran.groups, vec![(0..6).collect::<Vec<_>>(); 5], "together again, in the same order");
    assert_eq!(ran.times(), [0, 2, 5, 10, 19]);
    assert_eq!(ran.end, place.finished(&[]));
}

#[test]
fn a_group_goes_on_without_the_cells_that_others_work_on() {
    let place = Place::of(GROUPS);
    let lock = std::cell::Cell::new(place.folder.cell(place.id(1)).try_lock().unwrap());
    let script = |cell, attempt| match (cell, attempt) {
        (1, 1) => vec![ends(CellEvent::Busy)],
        (3, 1) => {
            drop(lock.take());
            vec![Wait(30), Succeeds, ends(CellEvent::Done)]
        }
        _ => done(),
    };
    let ran = place.run_in::<true>(THREES, false, &script);
    assert_eq!(ran.groups, [vec![0, 1, 2], vec![3, 4, 5], vec![1]]);
    assert_eq!(ran.end, place.finished(&[]));
}

#[test]
fn cells_of_a_group_share_the_time_of_its_process() {
    let place = Place::of(GROUPS);
    let script = |cell, _| match cell {
        0..3 => done(),
        _ => vec![server(), Wait(9), Succeeds, ends(CellEvent::Done)],
    };
    // Each finished cell took 10 s of process time.
    place.plan.cells[..3].iter().for_each(|cell| {
        place.folder.cell(&cell.id).write_timing(&crate::folder::Timing { seconds: 10.0 }).unwrap();
    });
    let ran = place.run_in::<true>(THREES, false, &script);
    let left = |second: usize| ran.statuses[second].remaining.map(|left| left.time.as_secs());
    // The second group starts at 2 s, and its first event arrives one second later. After another 6 s, each of its
    // three cells has had 2 s of process time.
    assert_eq!((left(2), left(3), left(9)), (Some(30), Some(30), Some(24)));
}

#[test]
fn test_episodes_are_counted_without_overflow() {
    const MANY: f64 = i64::MAX as f64; // the largest integer in TOML
    let plan =
        PLAN.replace("runs = 2", &format!("runs = 1\ntest_episodes = {}\ntest_versions = ['D', 'R', 'E']", i64::MAX));
    let plan = Plan::parse("test", plan).unwrap();
    assert_eq!(test_episodes(&plan.cells[0], None), 3.0 * MANY);
    assert_eq!(test_episodes(&plan.cells[0], Some("E")), 2.0 * MANY);
}
