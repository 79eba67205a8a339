use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;

const PLAN: &str = "environments = ['CartPole', 'Hopper']\nversions = ['D']\nruns = 2
    [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";

fn plan() -> Plan {
    Plan::parse("test", PLAN.into()).unwrap()
}

/// Runs with the shell script that `script` makes for a cell's folder as a worker.
fn run_with(
    folder: &Folder,
    jobs: usize,
    retry_failed: bool,
    stop: &StopFlag,
    script: &dyn Fn(&Cell, &Path) -> String,
) -> Result<RunEnd, RunError> {
    let worker = |cell: &Cell, attempt: Attempt| {
        let place = folder.cell(&cell.id);
        std::fs::create_dir_all(place.path())?;
        let mut command = Command::new("sh");
        command.arg("-c").arg(script(cell, place.path())).current_dir(place.path());
        command.env("LOSSES", attempt.losses.to_string());
        Ok(command)
    };
    let options = RunOptions { jobs, retry_failed, worker: &worker, server_trouble: &|| None };
    run(&plan(), folder, &options, stop, &mut |_| {})
}

fn lines(path: &Path) -> usize {
    std::fs::read_to_string(path).map_or(0, |text| text.lines().count())
}

#[test]
fn every_cell_is_done_once_and_a_second_run_does_nothing() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let script = |_: &Cell, _: &Path| "echo x >> count; sleep 0.05; echo x > result.json".to_owned();
    for _ in 0..2 {
        let end = run_with(&folder, 3, false, &StopFlag::default(), &script).unwrap();
        assert_eq!(end, RunEnd::Finished { failed: Vec::new() });
    }
    for cell in &plan().cells {
        assert_eq!(lines(&folder.cell(&cell.id).path().join("count")), 1, "{}", cell.id);
    }
}

#[test]
fn a_failed_cell_is_recorded_and_retried_on_request_only() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let ids: Vec<String> = plan().cells.iter().map(|cell| cell.id.clone()).collect();
    let failing = |cell: &Cell, path: &Path| {
        if cell.index == 2 {
            format!("echo x >> count; echo no memory > {}; exit 3", path.join("log.txt").display())
        } else {
            "echo x > result.json".to_owned()
        }
    };
    let failed = RunEnd::Finished { failed: vec![ids[2].clone()] };
    let count = folder.cell(&ids[2]).path().join("count");
    for _ in 0..2 {
        assert_eq!(run_with(&folder, 2, false, &StopFlag::default(), &failing).unwrap(), failed);
        assert_eq!(lines(&count), 1);
    }
    let failure = std::fs::read_to_string(folder.cell(&ids[2]).path().join("failure.json")).unwrap();
    assert!(failure.contains("its process ended with exit status: 3: no memory"), "{failure}");
    let mending = |_: &Cell, _: &Path| "echo x >> count; rm failure.json; echo x > result.json".to_owned();
    let end = run_with(&folder, 2, true, &StopFlag::default(), &mending).unwrap();
    assert_eq!(end, RunEnd::Finished { failed: Vec::new() });
    assert_eq!(lines(&count), 2);
}

#[test]
fn a_worker_that_is_killed_is_started_again_but_not_for_ever() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let script = |cell: &Cell, _: &Path| match cell.index {
        0 => "echo x >> count; kill -9 $$".to_owned(),
        1 => "echo x >> count; test $(wc -l < count) = 3 && echo x > result.json; kill -9 $$".to_owned(),
        _ => "echo x > result.json".to_owned(),
    };
    let end = run_with(&folder, 2, false, &StopFlag::default(), &script).unwrap();
    let plan = plan();
    assert_eq!(end, RunEnd::Finished { failed: vec![plan.cells[0].id.clone()] });
    assert!([0, 1].map(|index: usize| lines(&folder.cell(&plan.cells[index].id).path().join("count"))) == [3, 3]);
}

#[test]
fn a_lost_server_or_plan_ends_the_run_and_blames_no_cell() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let script = |_: &Cell, _: &Path| "echo x >> count; echo gone > log.txt; exit 69".to_owned();
    let error = run_with(&folder, 1, false, &StopFlag::default(), &script).unwrap_err().to_string();
    assert!(error.contains("without a server") && error.contains("gone"), "{error}");
    assert_eq!(lines(&folder.cell(&plan().cells[0].id).path().join("count")), 5);
    let script = |_: &Cell, _: &Path| "echo no such cell > log.txt; exit 2".to_owned();
    let error = run_with(&folder, 1, false, &StopFlag::default(), &script).unwrap_err().to_string();
    assert!(error.contains("refused its command: no such cell"), "{error}");
    assert!(plan().cells.iter().all(|cell| !folder.cell(&cell.id).is_settled(true)));
}

#[test]
fn a_server_that_was_lost_for_a_moment_does_not_end_the_run() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let script = |cell: &Cell, _: &Path| match cell.index {
        0 => "echo $LOSSES >> count; test $(wc -l < count) = 3 || exit 69; echo x > result.json".to_owned(),
        _ => "echo x > result.json".to_owned(),
    };
    let end = run_with(&folder, 1, false, &StopFlag::default(), &script).unwrap();
    assert_eq!(end, RunEnd::Finished { failed: Vec::new() });
    let losses = std::fs::read_to_string(folder.cell(&plan().cells[0].id).path().join("count")).unwrap();
    assert_eq!(losses, "0\n1\n2\n", "each worker knows how many servers the earlier ones have lost");
}

#[test]
fn a_worker_that_only_looked_for_a_server_had_none() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let (plan, worker) = (plan(), |_: &Cell, _: Attempt| Ok(Command::new("true")));
    let options = RunOptions { jobs: 1, retry_failed: false, worker: &worker, server_trouble: &|| None };
    let runner = Runner::new(&plan, &folder, &options);
    let log = folder.cell(&plan.cells[0].id).log();
    std::fs::create_dir_all(log.parent().unwrap()).unwrap();
    let earlier = format!("{ON}127.0.0.1:1\n");
    std::fs::write(&log, format!("{earlier}WARN the server 127.0.0.1:1 is silent\nno server answers\n")).unwrap();
    assert!(runner.found_a_server(0, 0));
    assert!(!runner.found_a_server(0, earlier.len() as u64), "an earlier worker had it");
    assert!(!runner.found_a_server(1, 0), "no log");
}

#[test]
fn servers_that_are_lost_in_a_row_are_waited_for_longer_and_longer_and_not_for_ever() {
    let mut losses = Losses::default();
    let mut pause = |seconds: u64| {
        losses.add(Duration::from_secs(seconds));
        losses.pause().map(|pause| pause.as_secs())
    };
    assert_eq!([0, 59, 0, 3].map(&mut pause), [1, 2, 4, 8].map(Some));
    assert_eq!([60, 0].map(&mut pause), [1, 2].map(Some), "a worker that ran for a minute had a server");
    assert_eq!([0, 0, 0].map(&mut pause), [Some(4), Some(8), None]);
    assert_eq!(losses.all, 9);
}

#[test]
fn an_earlier_failure_does_not_count_while_others_try_again() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let id = plan().cells[0].id.clone();
    let failure = Failure { id: id.clone(), reason: "earlier".into(), commit: "x".into() };
    folder.cell(&id).write_failure(&failure).unwrap();
    let script = |cell: &Cell, _: &Path| match cell.index {
        0 => format!("echo x >> count; test $(wc -l < count) = 2 || exit {NO_SERVER}; echo x > result.json"),
        _ => "echo x > result.json".to_owned(),
    };
    let end = run_with(&folder, 1, true, &StopFlag::default(), &script).unwrap();
    assert_eq!(end, RunEnd::Finished { failed: Vec::new() });
}

#[test]
fn a_failure_that_another_run_records_meanwhile_counts() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let id = plan().cells[2].id.clone();
    let failure = Failure { id: id.clone(), reason: "the same again".into(), commit: "x".into() };
    folder.cell(&id).write_failure(&failure).unwrap();
    // While cell 0 is done, another run tries cell 2 again, in vain.
    let script = |cell: &Cell, _: &Path| match cell.index {
        0 => {
            folder.cell(&id).forget_failure().unwrap();
            folder.cell(&id).write_failure(&failure).unwrap();
            "echo x > result.json".to_owned()
        }
        _ => "echo x >> count; rm -f failure.json; echo x > result.json".to_owned(),
    };
    let end = run_with(&folder, 1, true, &StopFlag::default(), &script).unwrap();
    assert_eq!(end, RunEnd::Finished { failed: vec![id.clone()] });
    assert_eq!(lines(&folder.cell(&id).path().join("count")), 0, "it is not tried once more");
}

#[test]
fn a_worker_that_fails_without_a_word_replaces_the_earlier_failure() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let id = plan().cells[0].id.clone();
    let failure = Failure { id: id.clone(), reason: "earlier".into(), commit: "x".into() };
    folder.cell(&id).write_failure(&failure).unwrap();
    let script = |cell: &Cell, _: &Path| match cell.index {
        0 => "echo no folder > log.txt; exit 1".to_owned(),
        _ => "echo x > result.json".to_owned(),
    };
    let end = run_with(&folder, 1, true, &StopFlag::default(), &script).unwrap();
    assert_eq!(end, RunEnd::Finished { failed: vec![id.clone()] });
    let text = std::fs::read_to_string(folder.cell(&id).path().join("failure.json")).unwrap();
    assert!(text.contains("exit status: 1: no folder"), "{text}");
}

#[test]
fn a_cell_that_another_run_works_on_is_waited_for_and_taken_over() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let cells = plan().cells;
    let lock = std::sync::Mutex::new(folder.cell(&cells[1].id).try_lock().unwrap());
    assert!(lock.lock().unwrap().is_some());
    let tries = AtomicUsize::new(0);
    let script = |cell: &Cell, _: &Path| {
        if cell.index != 1 {
            return "echo x > result.json".to_owned();
        }
        match tries.fetch_add(1, Ordering::SeqCst) {
            0 => format!("exit {BUSY}"),
            _ => "echo x > result.json".to_owned(),
        }
    };
    let end = std::thread::scope(|scope| {
        scope.spawn(|| {
            let start = Instant::now();
            while tries.load(Ordering::SeqCst) == 0 {
                assert!(start.elapsed() < Duration::from_secs(60));
                std::thread::sleep(TICK);
            }
            std::thread::sleep(Duration::from_millis(1500));
            assert_eq!(tries.load(Ordering::SeqCst), 1, "it is not started while it is locked");
            drop(lock.lock().unwrap().take());
        });
        run_with(&folder, 1, false, &StopFlag::default(), &script).unwrap()
    });
    assert_eq!(end, RunEnd::Finished { failed: Vec::new() });
    assert_eq!(tries.load(Ordering::SeqCst), 2);
}

#[test]
fn a_stopped_run_closes_the_workers_input_and_waits_for_them() {
    let directory = tempfile::tempdir().unwrap();
    let folder = Folder::new(directory.path());
    let stop = StopFlag::default();
    let script = |_: &Cell, _: &Path| "echo x > started; cat > /dev/null; echo x > stopped".to_owned();
    let cells = plan().cells;
    let at = |index: usize, name: &str| folder.cell(&cells[index].id).path().join(name);
    let end = std::thread::scope(|scope| {
        scope.spawn(|| {
            let start = Instant::now();
            while !(at(0, "started").exists() && at(1, "started").exists()) {
                assert!(start.elapsed() < Duration::from_secs(20));
                std::thread::sleep(TICK);
            }
            stop.raise(2);
        });
        run_with(&folder, 2, false, &stop, &script).unwrap()
    });
    assert_eq!(end, RunEnd::Stopped(2));
    assert!(at(0, "stopped").exists() && at(1, "stopped").exists());
    assert!(!at(2, "started").exists(), "no more than two at a time");
}

#[test]
fn the_remaining_time_follows_from_cells_of_the_same_kind() {
    let plan = plan();
    let [cart_pole, cart_pole_2, hopper, hopper_2] = &plan.cells[..] else { panic!() };
    let mut times = Times::default();
    let seconds = |times: &Times<'_>, cells: &[(&Cell, f64)], jobs: usize| {
        times.remaining(cells.iter().copied(), jobs).map(|time| time.as_secs_f64())
    };
    assert_eq!(seconds(&times, &[(hopper, 0.0)], 1), None);
    times.add(cart_pole, 10.0);
    assert_eq!(seconds(&times, &[(hopper, 0.0)], 1), Some(10.0), "nothing better is known");
    times.add(hopper, 30.0);
    let left = [(cart_pole_2, 4.0), (hopper_2, 0.0)];
    assert_eq!(seconds(&times, &left, 1), Some(36.0));
    assert_eq!(seconds(&times, &left, 2), Some(30.0), "the longest ends last");
    assert_eq!(seconds(&times, &left, 8), Some(30.0));
    assert_eq!(seconds(&times, &[(cart_pole_2, 99.0)], 1), Some(0.0));
}
