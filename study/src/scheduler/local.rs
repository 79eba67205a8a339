//! Cells in processes of this machine, one in each.

use std::fs::File;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use super::event::{last_words, read_lines, write_line};
use super::{Backend, CellEvent, News, Offer, Order, Result};
use crate::files::{create_folder, io};
use crate::folder::Folder;
use crate::plan::Plan;

/// Worker processes, each of which takes the lock of its cell itself.
pub struct Local<'a> {
    plan: &'a Plan,
    folder: &'a Folder,
    jobs: usize,
    command: &'a dyn Fn() -> Command,
    server_ended: &'a dyn Fn() -> Option<String>,
    workers: Vec<Worker>,
}

struct Worker {
    cell: usize,
    child: Child,
    events: File,
    /// Up to where they were read.
    offset: u64,
    last: Option<CellEvent>,
    log: PathBuf,
    /// Where its words begin in the cell's log, in bytes.
    log_start: u64,
}

impl<'a> Local<'a> {
    /// `jobs` workers at a time, at least 1, started by `command`; each reads an [`Order`] and writes
    /// [`Line`](super::Line)s. `server_ended` says how the server that they share ended, if it has.
    pub fn new(
        plan: &'a Plan,
        folder: &'a Folder,
        jobs: usize,
        command: &'a dyn Fn() -> Command,
        server_ended: &'a dyn Fn() -> Option<String>,
    ) -> Self {
        Self { plan, folder, jobs, command, server_ended, workers: Vec::new() }
    }

    fn start(&self, offer: &Offer) -> Result<Worker> {
        let cell = &self.plan.cells[offer.cell];
        let place = self.folder.cell(&cell.id);
        create_folder(place.path())?;
        let path = place.log();
        let log = File::options().create(true).append(true).open(&path).map_err(io("open", &path))?;
        let log_start = log.metadata().map_err(io("read", &path))?.len();
        let mut command = (self.command)();
        let program = PathBuf::from(command.get_program());
        let mut start = || {
            // A file, not a pipe: nobody has to read while the worker writes.
            let events = tempfile::tempfile()?;
            let child = command.stdin(Stdio::piped()).stdout(events.try_clone()?).stderr(log.try_clone()?).spawn()?;
            Ok((child, events))
        };
        let (mut child, events) = start().map_err(io("start a worker process of", &program))?;
        let order = Order { cell: cell.id.clone(), retry: offer.retry, turn: cell.index + offer.lost_servers };
        if let Some(input) = &mut child.stdin {
            write_line(input, &order);
        }
        Ok(Worker { cell: offer.cell, child, events, offset: 0, last: None, log: path, log_start })
    }
}

impl Worker {
    /// What it has said since the last call, and whether it has ended.
    fn news(&mut self) -> std::io::Result<(Vec<CellEvent>, bool)> {
        let status = self.child.try_wait()?; // before its words are read, so that they are the last
        let mut events: Vec<CellEvent> =
            read_lines(&self.events, &mut self.offset)?.into_iter().map(|line| line.event).collect();
        self.last = events.last().cloned().or(self.last.take());
        if let Some(status) = status.filter(|_| !self.last.as_ref().is_some_and(CellEvent::is_last)) {
            let words = last_words(&self.log, self.log_start).map_or_else(String::new, |words| format!(": {words}"));
            events.push(CellEvent::Killed { reason: format!("its process ended with {status}{words}") });
        }
        Ok((events, status.is_some()))
    }
}

impl Backend for Local<'_> {
    fn convicts(&self) -> bool {
        true
    }

    fn poll(&mut self, _now: Instant) -> Result<Vec<News>> {
        let mut news = Vec::new();
        for mut worker in std::mem::take(&mut self.workers) {
            let (events, ended) = worker.news().map_err(io("read what is told about", &worker.log))?;
            news.extend(events.into_iter().map(|event| News::Event(worker.cell, event)));
            if !ended {
                self.workers.push(worker);
            }
        }
        news.extend((self.server_ended)().map(News::NoServer));
        Ok(news)
    }

    fn room(&self) -> usize {
        self.jobs.saturating_sub(self.workers.len())
    }

    fn begin(&mut self, offers: &[Offer]) -> Result<Vec<usize>> {
        for offer in offers {
            let worker = self.start(offer)?;
            self.workers.push(worker);
        }
        Ok(offers.iter().map(|offer| offer.cell).collect())
    }

    fn load(&self) -> (String, usize) {
        (format!("{} running", self.workers.len()), self.jobs)
    }

    /// Asks all workers to stop, and waits for them. They finish their iteration first.
    fn stop(&mut self) -> Vec<String> {
        for worker in &mut self.workers {
            drop(worker.child.stdin.take());
        }
        for mut worker in self.workers.drain(..) {
            let _ = worker.child.wait(); // an error means that it has been waited for
        }
        Vec::new()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::{Announcement, Line, RunEnd, run};
    use super::*;
    use crate::interrupt::StopFlag;

    /// Two cells.
    const PLAN: &str = "environments = ['CartPole']\nversions = ['D']\nruns = 2
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    /// What every worker of these tests begins with: it reads its order, and works in its cell's folder.
    const BEGIN: &str = r#"read -r order; id=${order#*:\"}; id=${id%%\"*}; cd "cells/$id"; echo "$order" >>orders
        say() { echo "{\"cell\":\"$id\",\"event\":$1}"; };"#;

    struct Ran {
        end: Result<RunEnd>,
        lines: Vec<Line>,
    }

    /// Runs with a shell script as a worker.
    fn run_script(folder: &Folder, script: &str, stop: &StopFlag, server_ended: &dyn Fn() -> Option<String>) -> Ran {
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        let command = || {
            let mut command = Command::new("sh");
            command.arg("-c").arg(format!("{BEGIN} {script}")).current_dir(folder.path());
            command
        };
        let mut local = Local::new(&plan, folder, 2, &command, server_ended);
        let mut lines = Vec::new();
        let mut report = |report: Announcement<'_>| {
            if let Announcement::Line(line) = report {
                lines.push(line.clone());
            }
        };
        let end = run(&plan, folder, &mut local, false, stop, &mut report);
        Ran { end, lines }
    }

    fn place() -> (tempfile::TempDir, Folder, [String; 2]) {
        let directory = tempfile::tempdir().unwrap();
        let folder = Folder::new(directory.path());
        let plan = Plan::parse("test", PLAN.into()).unwrap();
        (directory, folder, [0, 1].map(|cell: usize| plan.cells[cell].id.clone()))
    }

    #[test]
    fn a_worker_reads_its_order_and_its_lines_are_heard() {
        let (_directory, folder, ids) = place();
        let script = "say '\"server\",\"address\":\"unix:/x\"'; echo x >result.json; say '\"done\"'";
        let ran = run_script(&folder, script, &StopFlag::default(), &|| None);
        assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: Vec::new() });
        for (turn, id) in ids.iter().enumerate() {
            let orders = std::fs::read_to_string(folder.cell(id).path().join("orders")).unwrap();
            assert_eq!(orders, format!("{{\"cell\":\"{id}\",\"retry\":null,\"turn\":{turn}}}\n"));
            let events: Vec<String> = ran.lines.iter().filter(|line| line.cell == *id).map(said).collect();
            assert_eq!(events, [r#"{"event":"server","address":"unix:/x"}"#, r#"{"event":"done"}"#]);
        }
    }

    fn said(line: &Line) -> String {
        serde_json::to_string(&line.event).unwrap()
    }

    #[test]
    fn a_worker_without_a_last_line_was_killed_and_its_log_may_say_why() {
        let (_directory, folder, ids) = place();
        std::fs::create_dir_all(folder.cell(&ids[1]).path()).unwrap();
        std::fs::write(folder.cell(&ids[1]).log(), "of an earlier run\n").unwrap();
        let script = format!("test $id = {} || kill -9 $$; echo no memory >&2; exit 3", ids[0]);
        let ran = run_script(&folder, &script, &StopFlag::default(), &|| None);
        assert_eq!(ran.end.unwrap(), RunEnd::Finished { failed: ids.to_vec() });
        let recorded = "3 attempts in a row have not brought it any further";
        for (id, how) in ids.iter().zip(["exit status: 3: no memory", "signal: 9 (SIGKILL)"]) {
            let failure = std::fs::read_to_string(folder.cell(id).path().join("failure.json")).unwrap();
            assert!(failure.contains(&format!("its process ended with {how}; {recorded}")), "{failure}");
        }
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
    fn the_end_of_the_shared_server_is_that_of_the_run() {
        let (_directory, folder, _) = place();
        let stop = StopFlag::default();
        let ran = run_script(&folder, "cat >/dev/null", &stop, &|| Some("the private server ended".into()));
        let message = ran.end.unwrap_err().to_string();
        assert!(message.starts_with("the run cannot go on without a server: the private server ended;"), "{message}");
    }
}
