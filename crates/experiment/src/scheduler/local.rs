//! The backend that runs cells in worker processes on this machine, one group of cells in each process.

use std::collections::{BTreeMap, HashSet};
use std::fs::File;
use std::io::Write;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use perturb_files::{FileError, create_folder, io, temporary_file};
use perturb_protocol::spawn_failure;

use super::event::{last_log_line, read_lines, write_line};
use super::{Backend, BackendEvent, CellEvent, JobCell, PendingCell, Result, WorkerJob};
use crate::folder::ExperimentFolder;
use crate::plan::{Grouping, Plan};

/// A [`Backend`] that runs worker processes on this machine. Each worker locks its own cells.
pub struct Local<'a> {
    plan: &'a Plan,
    folder: &'a ExperimentFolder,
    grouping: Grouping,
    command: &'a dyn Fn(usize) -> Command,
    server: &'a dyn Fn() -> Option<BackendEvent>,
    workers: Vec<Worker>,
    /// Measured upper bounds of the cells' durations by index in the plan, in seconds of process time.
    max_seconds: Vec<Option<f64>>,
}

/// A worker process and the cells of its group.
struct Worker {
    /// The unfinished cells: index in the plan by cell id.
    cells: BTreeMap<String, usize>,
    /// Indices of the cells that the worker has started.
    begun: HashSet<usize>,
    /// The lowest number, from 0, that no other worker had when this one was started.
    slot: usize,
    child: Child,
    events: File,
    /// Number of bytes of `events` that have been read.
    offset: u64,
    log: PathBuf,
    /// Size of the log in bytes when the worker started: its own output begins here.
    log_start: u64,
}

impl<'a> Local<'a> {
    /// Returns a backend with up to `grouping.at_a_time` workers at a time. `command` returns the command that starts a
    /// worker, given the worker's slot: the lowest free number from 0. Each worker must read a [`WorkerJob`] and write
    /// [`EventLine`](super::EventLine)s. The backend calls `server` at every poll for events of the servers.
    pub fn new(
        plan: &'a Plan,
        folder: &'a ExperimentFolder,
        grouping: Grouping,
        command: &'a dyn Fn(usize) -> Command,
        server: &'a dyn Fn() -> Option<BackendEvent>,
    ) -> Self {
        Self { plan, folder, grouping, command, server, workers: Vec::new(), max_seconds: Vec::new() }
    }

    /// Sets the measured upper bounds of the cells' durations by index in the plan, in seconds of process time.
    pub fn with_max_seconds(self, max_seconds: Vec<Option<f64>>) -> Self {
        Self { max_seconds, ..self }
    }

    /// Starts a worker process for a group, and sends it its job. Returns `None` for an empty group.
    fn start(&self, group: &[PendingCell]) -> Result<Option<Worker>> {
        let Some(first) = group.first() else { return Ok(None) };
        let cells: Vec<JobCell> =
            group.iter().map(|offer| JobCell { cell: self.id(offer.cell).into(), retry: offer.retry }).collect();
        let (log, path) = self.open_logs(group)?;
        let log_start = log.metadata().map_err(io("read", &path))?.len();
        let is_free = |slot: &usize| self.workers.iter().all(|worker| worker.slot != *slot);
        let slot = (0..self.workers.len()).find(is_free).unwrap_or(self.workers.len());
        let mut command = (self.command)(slot);
        let program = PathBuf::from(command.get_program());
        let mut start = || {
            // Events go to a file, because a full pipe would block the worker while nobody reads it.
            let events = temporary_file()?;
            let spawned = command.stdin(Stdio::piped()).stdout(events.try_clone()?).stderr(log.try_clone()?).spawn();
            let failed = |error: std::io::Error| std::io::Error::new(error.kind(), spawn_failure(&error));
            Ok((spawned.map_err(failed)?, events))
        };
        let (mut child, events) = start().map_err(io("start a worker process of", &program))?;
        let job = WorkerJob { cells, turn: self.first_turn().wrapping_add(first.group + first.lost_servers) };
        if let Some(input) = &mut child.stdin {
            write_line(input, &job);
        }
        let cells = group.iter().map(|offer| (self.id(offer.cell).to_owned(), offer.cell)).collect();
        Ok(Some(Worker { cells, begun: HashSet::new(), slot, child, events, offset: 0, log: path, log_start }))
    }

    /// Opens the log of a group: the log file of its first cell. Appends a reference to it to the logs of the other
    /// cells.
    fn open_logs(&self, group: &[PendingCell]) -> Result<(File, PathBuf), FileError> {
        let open = |offer: &PendingCell| {
            let place = self.folder.cell(self.id(offer.cell));
            create_folder(place.path())?;
            let path = place.log();
            let log = File::options().create(true).append(true).open(&path).map_err(io("open", &path))?;
            Ok((log, path))
        };
        let first = open(&group[0])?;
        for offer in &group[1..] {
            let (mut log, path) = open(offer)?;
            let first = self.id(group[0].cell);
            writeln!(log, "runs in one process with {first}: see ../{first}/log.txt").map_err(io("write", &path))?;
        }
        Ok(first)
    }

    /// Returns the index of the server for the first group: a hash of the id of the plan's first cell. With a fixed
    /// index, separate runs of single cells, such as jobs of a cluster, would all start with the same server.
    fn first_turn(&self) -> usize {
        self.plan.cells.first().map_or(0, |cell| crc32c::crc32c(cell.id.as_bytes()) as usize)
    }

    fn id(&self, cell: usize) -> &'a str {
        &self.plan.cells[cell].id
    }
}

impl Worker {
    /// Returns the worker's events since the last call, and whether the worker has ended.
    fn poll_events(&mut self) -> std::io::Result<(Vec<BackendEvent>, bool)> {
        let status = self.child.try_wait()?; // before reading its events, so that none is missed after its end
        let mut events = Vec::new();
        for line in read_lines(&self.events, &mut self.offset)? {
            let Some(&cell) = self.cells.get(&line.cell) else { continue };
            if line.event.shows_work() {
                self.begun.insert(cell);
            }
            if line.event.is_last() {
                self.cells.remove(&line.cell);
            }
            events.push(BackendEvent::Event(cell, line.event));
        }
        if let Some(status) = status.filter(|_| !self.cells.is_empty()) {
            let words = last_log_line(&self.log, self.log_start).map_or_else(String::new, |words| format!(": {words}"));
            let reason = format!("its process ended with {status}{words}");
            let mut killed: Vec<usize> = std::mem::take(&mut self.cells).into_values().collect();
            killed.sort_unstable();
            events.extend(killed.into_iter().map(|cell| match self.begun.is_empty() || self.begun.contains(&cell) {
                true => BackendEvent::Event(cell, CellEvent::Killed { reason: reason.clone() }),
                // The process had not started this cell, so its end does not count as a failed attempt.
                false => BackendEvent::Returned(cell),
            }));
        }
        Ok((events, status.is_some()))
    }
}

impl Backend for Local<'_> {
    fn grouping(&self) -> Grouping {
        self.grouping
    }

    fn records_crashes_as_failures(&self) -> bool {
        true
    }

    fn reports_ends(&self) -> bool {
        true
    }

    fn poll(&mut self, _now: Instant) -> Result<Vec<BackendEvent>> {
        let mut events = Vec::new();
        for mut worker in std::mem::take(&mut self.workers) {
            let (said, ended) = worker.poll_events().map_err(io("read what is told about", &worker.log))?;
            events.extend(said);
            if !ended {
                self.workers.push(worker);
            }
        }
        events.extend((self.server)());
        Ok(events)
    }

    fn free_slots(&self) -> usize {
        self.grouping.at_a_time.saturating_sub(self.workers.len())
    }

    fn begin(&mut self, groups: &[Vec<PendingCell>]) -> Result<Vec<usize>> {
        for group in groups {
            let worker = self.start(group)?;
            self.workers.extend(worker);
        }
        Ok(groups.iter().flatten().map(|offer| offer.cell).collect())
    }

    fn max_seconds(&self, cell: usize) -> Option<f64> {
        self.max_seconds.get(cell).copied().flatten()
    }

    fn load(&self) -> (String, usize) {
        let cells: usize = self.workers.iter().map(|worker| worker.cells.len()).sum();
        let processes = self.workers.len();
        let shown = if processes == 1 { "1 process".to_owned() } else { format!("{processes} processes") };
        (format!("{cells} in {shown}"), processes.max(1))
    }

    /// Asks all workers to stop, and waits until they have ended. Workers finish their current iteration first.
    fn stop(&mut self) -> Vec<String> {
        for worker in &mut self.workers {
            drop(worker.child.stdin.take());
        }
        for mut worker in self.workers.drain(..) {
            let _ = worker.child.wait(); // an error means that the process has already been waited for
        }
        Vec::new()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;
    use std::time::Duration;

    use super::super::{EventLine, ProgressEvent, RunEnd, run};
    use super::*;
    use perturb_files::interrupt::StopFlag;

    /// A plan with two cells.
    const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\nruns = 2
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    /// Start of the shell script that replaces workers in these tests. It reads its job and changes to the folder of
    /// its cell.
    const BEGIN: &str = r#"read -r order; id=${order#*:\"}; id=${id%%\"*}; cd "cells/$id"; echo "$order" >>orders
        echo "$SEAT" >>seats
        say() { echo "{\"cell\":\"$id\",\"event\":$1}"; };"#;

    struct Ran {
        end: Result<RunEnd>,
        lines: Vec<EventLine>,
    }

    /// Runs the plan with a shell script in place of each worker. Each worker gets one cell.
    fn run_script(
        folder: &ExperimentFolder,
        script: &str,
        stop: &StopFlag,
        server: &dyn Fn() -> Option<BackendEvent>,
    ) -> Ran {
        run_grouped(Grouping { max_cells: 1, at_a_time: 2 }, folder, script, stop, server)
    }

    fn run_grouped(
        grouping: Grouping,
        folder: &ExperimentFolder,
        script: &str,
        stop: &StopFlag,
        server: &dyn Fn() -> Option<BackendEvent>,
    ) -> Ran {
        run_plan(&Plan::parse("test", PLAN.into()).unwrap(), grouping, folder, script, stop, server)
    }

    fn run_plan(
        plan: &Plan,
        grouping: Grouping,
        folder: &ExperimentFolder,
        script: &str,
        stop: &StopFlag,
        server: &dyn Fn() -> Option<BackendEvent>,
    ) -> Ran {
        let command = |slot: usize| {
            let mut command = Command::new("sh");
            command.arg("-c").arg(format!("{BEGIN} {script}")).current_dir(folder.path()).env("SEAT", slot.to_string());
            command
        };
        let mut local = Local::new(plan, folder, grouping, &command, server);
        let mut lines = Vec::new();
        let mut report = |report: ProgressEvent<'_>| {
            if let ProgressEvent::Line(line) = report {
                lines.push(line.clone());
            }
        };
        let end = run(plan, folder, &mut local, &HashMap::new(), Duration::ZERO, stop, &mut report);
        Ran { end, lines }
    }

    fn place() -> (tempfile::TempDir, ExperimentFolder, [String; 2]) {
        let directory = tempfile::tempdir().unwrap();
        let folder = ExperimentFolder::new(directory.path());
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        (directory, folder, [0, 1].map(|cell: usize| plan.cells[cell].id.clone()))
    }

    #[test]
    fn a_worker_reads_its_order_and_its_lines_are_heard() {
        for at_a_time in [1, 2] {
            orders_are_read(at_a_time);
        }
    }

    fn orders_are_read(at_a_time: usize) {
        let (_directory, folder, ids) = place();
        let script = "say '\"server\",\"address\":\"unix:/x\"'; echo x >result.json; say '\"done\"'";
        let grouping = Grouping { max_cells: 1, at_a_time };
        let ran = run_grouped(grouping, &folder, script, &StopFlag::default(), &|| None);
        assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: Vec::new() });
        for (number, id) in ids.iter().enumerate() {
            let orders = std::fs::read_to_string(folder.cell(id).path().join("orders")).unwrap();
            let job: WorkerJob = serde_json::from_str(&orders).unwrap();
            assert_eq!(job.cells, [JobCell { cell: id.clone(), retry: None }]);
            assert_eq!(
                job.turn,
                turn(&ids[0], number),
                "cells take the servers in turn, even if there are more servers than workers"
            );
            let events: Vec<String> = ran.lines.iter().filter(|line| line.cell == *id).map(said).collect();
            assert_eq!(events, [r#"{"event":"server","address":"unix:/x"}"#, r#"{"event":"done"}"#]);
        }
    }

    fn turn(first: &str, number: usize) -> usize {
        crc32c::crc32c(first.as_bytes()) as usize + number
    }

    #[test]
    fn worker_takes_lowest_free_slot_and_next_server() {
        let (_directory, folder, _) = place();
        let plan = Plan::parse("test", PLAN.replace("runs = 2", "runs = 3")).unwrap();
        let [first, second, third] = [0, 1, 2].map(|cell: usize| plan.cells[cell].id.clone());
        // The second cell runs until the others are done. The third cell loses its first server.
        let script = format!(
            r#"case "$id" in
                {second}) for _ in $(seq 2000); do
                    [ -e ../{third}/result.json ] && [ -e ../{first}/result.json ] && break; sleep 0.01; done ;;
                {third}) if [ "$(wc -l <seats)" = 1 ]; then say '"lost_server","reason":"gone"'; exit; fi ;;
            esac
            echo x >result.json; say '"done"'"#
        );
        let grouping = Grouping { max_cells: 1, at_a_time: 2 };
        let ran = run_plan(&plan, grouping, &folder, &script, &StopFlag::default(), &|| None);
        assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: Vec::new() });
        let read = |id: &str, name: &str| std::fs::read_to_string(folder.cell(id).path().join(name)).unwrap();
        assert_eq!([&first, &second, &third].map(|id| read(id, "seats")), ["0\n", "1\n", "0\n0\n"]);
        let turns = |id: &str| -> Vec<usize> {
            let orders = read(id, "orders");
            orders.lines().map(|job| serde_json::from_str::<WorkerJob>(job).unwrap().turn).collect()
        };
        assert_eq!(turns(&second), [turn(&first, 1)]);
        assert_eq!(turns(&third), [turn(&first, 2), turn(&first, 3)]);
    }

    fn said(line: &EventLine) -> String {
        serde_json::to_string(&line.event).unwrap()
    }

    #[test]
    fn worker_without_last_line_counts_as_killed() {
        let (_directory, folder, ids) = place();
        std::fs::create_dir_all(folder.cell(&ids[1]).path()).unwrap();
        std::fs::write(folder.cell(&ids[1]).log(), "of an earlier run\n").unwrap();
        let script = format!("test $id = {} || kill -9 $$; echo no memory >&2; exit 3", ids[0]);
        let ran = run_script(&folder, &script, &StopFlag::default(), &|| None);
        assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: ids.to_vec() });
        let recorded = "3 attempts in a row made no progress";
        for (id, how) in ids.iter().zip(["exit status: 3: no memory", "signal: 9 (SIGKILL)"]) {
            let failure = std::fs::read_to_string(folder.cell(id).path().join("failure.json")).unwrap();
            assert!(failure.contains(&format!("its process ended with {how}; {recorded}")), "{failure}");
        }
    }

    #[test]
    fn dead_worker_loses_only_its_running_cells() {
        let (.., ids) = place();
        let [first, second] = &ids;
        // The worker dies after the first cell. The second cell is started again. If it had begun, it counts as killed,
        // and the reason contains the last line of the log.
        let script = format!(
            r#"case "$order" in
                *{first}*) echo x >result.json; say '"done"'; id={second}; say '"server","address":"unix:/x"'
                    [ -z "$WORKED" ] || say '"testing","set":"D","episodes":1'; echo "lost" >&2; kill -9 $$ ;;
                *) echo x >result.json; say '"done"' ;;
            esac"#
        );
        for had_begun in [false, true] {
            let (_directory, folder, _) = place();
            let script = format!("WORKED={}; {script}", if had_begun { "1" } else { "" });
            let grouping = Grouping { max_cells: 2, at_a_time: 1 };
            let ran = run_grouped(grouping, &folder, &script, &StopFlag::default(), &|| None);
            assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: Vec::new() });
            let events = ran.lines.iter().map(|line| (&*line.cell, line.event.to_string()));
            let killed = || "its process ended with signal: 9 (SIGKILL): lost".to_owned();
            let mut expected = vec![(&**first, "done".to_owned()), (second, "on unix:/x".to_owned())];
            if had_begun {
                expected.extend([(&**second, "1 test episode on D".to_owned()), (second, killed())]);
            }
            expected.push((second, "done".to_owned()));
            assert_eq!(events.collect::<Vec<_>>(), expected);
            logs_of_a_group(&folder, &ids);
        }
    }

    #[track_caller]
    fn logs_of_a_group(folder: &ExperimentFolder, [first, second]: &[String; 2]) {
        let read = |id: &String, name: &str| std::fs::read_to_string(folder.cell(id).path().join(name)).unwrap();
        let job: WorkerJob = serde_json::from_str(&read(first, "orders")).unwrap();
        assert_eq!(job.cells.iter().map(|it| &it.cell).collect::<Vec<_>>(), [first, second]);
        assert_eq!(read(second, "log.txt"), format!("runs in one process with {first}: see ../{first}/log.txt\n"));
    }

    #[test]
    fn a_stopped_run_closes_the_workers_input_and_waits_for_them() {
        let (_directory, folder, ids) = place();
        let at = |id: &String, name: &str| folder.cell(id).path().join(name).exists();
        let stop = StopFlag::default();
        let ran = std::thread::scope(|scope| {
            scope.spawn(|| {
                let start = Instant::now();
                while !ids.iter().all(|id| at(id, "started")) && start.elapsed() < Duration::from_secs(20) {
                    std::thread::sleep(Duration::from_millis(10));
                }
                stop.raise(2);
            });
            run_script(&folder, "echo x >started; cat >/dev/null; echo x >stopped", &stop, &|| None)
        });
        assert_eq!(ran.end.unwrap(), RunEnd::Stopped { signal: 2, left: Vec::new() });
        assert!(ids.iter().all(|id| at(id, "stopped")));
    }

    #[test]
    fn the_end_of_the_shared_server_ends_the_run() {
        let (_directory, folder, _) = place();
        let stop = StopFlag::default();
        let ran = run_script(&folder, "cat >/dev/null", &stop, &|| {
            Some(BackendEvent::NoServer("the private server ended".into()))
        });
        let message = ran.end.unwrap_err().to_string();
        assert!(
            message.starts_with("the run cannot continue without a server: the private server ended;"),
            "{message}"
        );
    }
}
