//! Messages between a run and its worker processes: JSON objects, one per line, on the worker's standard input and
//! output.

use std::collections::HashMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::time::{Duration, Instant};

use perturb_files::open_plain;
use serde::{Deserialize, Serialize};

use super::count;
use crate::folder::FailureId;

/// Interval between progress messages of a worker that has one cell.
const INTERVAL: Duration = Duration::from_secs(1);
/// Maximum factor for [`INTERVAL`]. A worker with several cells multiplies the interval by the number of its cells, up
/// to this factor.
const MAX_INTERVALS: u32 = 10;
/// Maximum number of bytes at the end of a log that are searched for its last non-empty line.
const MAX_LAST_WORDS_BYTES: u64 = 64 << 10;

/// The job of a worker process: the only line that it reads from its standard input. A worker stops when its standard
/// input is closed. This also happens when the process that started the worker dies.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerJob {
    /// The cells that the worker runs together, at least one.
    pub cells: Vec<JobCell>,
    /// Selects the server: its index is `turn` modulo the number of servers.
    pub turn: usize,
}

/// A cell of a [`WorkerJob`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobCell {
    /// The cell's id.
    pub cell: String,
    /// The recorded failure that the worker may delete to run the cell again; `None` if the worker must keep failures.
    pub retry: Option<FailureId>,
}

/// A line that a worker writes to its standard output: `{"cell": "…", "event": "training", …}`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct EventLine {
    /// The cell's id.
    pub cell: String,
    /// The event.
    #[serde(flatten)]
    pub event: CellEvent,
}

/// An event of a cell. `Server`, `Training` and `Testing` report progress. Every other event ends the worker's attempt
/// at the cell and is the worker's last line about it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
#[expect(missing_docs, reason = "the variants say what their fields are")]
pub enum CellEvent {
    /// The cell uses the server at this address.
    Server { address: String },
    /// The training has done this many episodes and steps. Of these, `saved` steps are in a checkpoint, where another
    /// attempt would resume. The first such event of an attempt reports where the attempt starts.
    Training { episodes: u64, timesteps: u64, saved: u64 },
    /// The test of the policy on this set has done this many episodes.
    Testing { set: String, episodes: u64 },
    /// The cell has a result, from this attempt or an earlier one.
    Done,
    /// The cell failed with this reason, in this attempt or an earlier one.
    Failed { reason: String },
    /// Another process is working on the cell.
    Busy,
    /// No server was found, or the connection to it was lost. This does not count as a failure of the cell.
    LostServer { reason: String },
    /// A file could not be read or written, for example because the disk is full. This does not count as a failure of
    /// the cell. The training so far is kept.
    FileFault { reason: String },
    /// A signal stopped the worker. The training so far is kept.
    Stopped { signal: i32 },
    /// The job contains a cell that is not in the worker's plan.
    Refused { reason: String },
    /// The worker ended without a last line about the cell. The process that started the worker writes this event;
    /// `reason` describes how the worker ended.
    Killed { reason: String },
}

impl CellEvent {
    /// Returns whether the event shows that the worker has started work on the cell. `Server` does not show this,
    /// because all cells of a group get their server at the start.
    pub(super) fn shows_work(&self) -> bool {
        !matches!(self, Self::Server { .. })
    }

    /// Returns whether the event ends the worker's attempt at the cell, so that no other event of the cell follows.
    pub fn is_last(&self) -> bool {
        !matches!(self, Self::Server { .. } | Self::Training { .. } | Self::Testing { .. })
    }

    /// Returns a value that identifies the stage of a `Training` or `Testing` event: the training up to the next
    /// checkpoint, or a test set. Returns `None` for other events.
    fn stage(&self) -> Option<(&str, u64)> {
        match self {
            Self::Training { saved, .. } => Some(("", *saved)),
            Self::Testing { set, .. } => Some((set, 0)),
            _ => None,
        }
    }
}

impl std::fmt::Display for CellEvent {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Server { address } => write!(f, "on {address}"),
            Self::Training { episodes, .. } => write!(f, "{} of training", count(*episodes as usize, "episode")),
            Self::Testing { set, episodes } => write!(f, "{} on {set}", count(*episodes as usize, "test episode")),
            Self::Done => write!(f, "done"),
            Self::Busy => write!(f, "another process is working on it"),
            Self::Stopped { signal } => write!(f, "signal {signal} ended its process"),
            Self::Failed { reason }
            | Self::LostServer { reason }
            | Self::FileFault { reason }
            | Self::Refused { reason }
            | Self::Killed { reason } => write!(f, "{reason}"),
        }
    }
}

/// Writes the events of a group's cells as [`EventLine`]s, and limits the rate of progress events.
pub struct EventLineWriter<W> {
    out: W,
    interval: Duration,
    /// The last written event of each cell, and when it was written.
    last: HashMap<String, (CellEvent, Instant)>,
}

impl<W: Write> EventLineWriter<W> {
    /// Returns a writer to `out` for a worker with `cells` cells.
    pub fn new(cells: usize, out: W) -> Self {
        let intervals = cells.clamp(1, MAX_INTERVALS as usize) as u32;
        Self { out, interval: INTERVAL * intervals, last: HashMap::new() }
    }

    /// Writes an event of the cell with this id. Skips a `Training` or `Testing` event if the cell's last written event
    /// is of the same stage and more recent than the interval.
    pub fn write(&mut self, cell: &str, event: CellEvent) {
        let is_recent =
            |(last, time): &(CellEvent, Instant)| time.elapsed() < self.interval && last.stage() == event.stage();
        if event.stage().is_some() && self.last.get(cell).is_some_and(is_recent) {
            return;
        }
        self.last.insert(cell.to_owned(), (event.clone(), Instant::now()));
        write_line(&mut self.out, &EventLine { cell: cell.to_owned(), event });
    }
}

/// Writes `line` as JSON. Ignores write errors, because the results are in the experiment's folder.
pub fn write_line(out: &mut impl Write, line: &impl Serialize) {
    let Ok(mut text) = serde_json::to_vec(line) else { return };
    text.push(b'\n');
    if let Err(error) = out.write_all(&text).and_then(|()| out.flush()) {
        tracing::debug!(%error, "a line cannot be written");
    }
}

/// Reads the complete lines in `file` from byte `offset` on, and sets `offset` to the end of the last one. Skips all
/// text that is not an event, because for example the prologue of a cluster's job may write to the same file.
pub(super) fn read_lines(file: &File, offset: &mut u64) -> std::io::Result<Vec<EventLine>> {
    let mut new = Vec::new();
    let mut piece = [0; 1 << 14];
    loop {
        match file.read_at(&mut piece, *offset + new.len() as u64)? {
            0 => break,
            count => new.extend_from_slice(&piece[..count]),
        }
    }
    let Some(end) = new.iter().rposition(|&byte| byte == b'\n') else { return Ok(Vec::new()) };
    *offset += end as u64 + 1;
    Ok(new[..end].split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok()).collect())
}

/// Returns the last non-empty line of `log` after byte `start`. It may contain the reason why a process ended.
pub(super) fn last_log_line(log: &Path, start: u64) -> Option<String> {
    let (mut file, metadata) = open_plain(log).ok()?;
    let mut text = Vec::new();
    file.seek(SeekFrom::Start(start.max(metadata.len().saturating_sub(MAX_LAST_WORDS_BYTES)))).ok()?;
    file.take(MAX_LAST_WORDS_BYTES).read_to_end(&mut text).ok()?;
    let text = String::from_utf8_lossy(&text);
    text.lines().rev().find(|line| !line.trim().is_empty()).map(str::to_owned)
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case(CellEvent::Server { address: "unix:/x".into() }, r#""server","address":"unix:/x"}"#)]
    #[case(
        CellEvent::Training { episodes: 3, timesteps: 40, saved: 20 },
        r#""training","episodes":3,"timesteps":40,"saved":20}"#
    )]
    #[case(CellEvent::Testing { set: "D".into(), episodes: 5 }, r#""testing","set":"D","episodes":5}"#)]
    #[case(CellEvent::Done, r#""done"}"#)]
    #[case(CellEvent::Failed { reason: "NaN".into() }, r#""failed","reason":"NaN"}"#)]
    #[case(CellEvent::Busy, r#""busy"}"#)]
    #[case(CellEvent::FileFault { reason: "full".into() }, r#""file_fault","reason":"full"}"#)]
    #[case(CellEvent::LostServer { reason: "gone".into() }, r#""lost_server","reason":"gone"}"#)]
    #[case(CellEvent::Stopped { signal: 15 }, r#""stopped","signal":15}"#)]
    #[case(CellEvent::Refused { reason: "no".into() }, r#""refused","reason":"no"}"#)]
    #[case(CellEvent::Killed { reason: "no".into() }, r#""killed","reason":"no"}"#)]
    fn a_line_is_a_flat_object_and_reads_back(#[case] event: CellEvent, #[case] text: &str) {
        let line = EventLine { cell: "a".into(), event };
        let text = format!(r#"{{"cell":"a","event":{text}"#);
        assert_eq!(serde_json::to_string(&line).unwrap(), text);
        assert_eq!(serde_json::from_str::<EventLine>(&text).unwrap(), line);
    }

    #[test]
    fn progress_is_sent_each_second_and_checkpoints_at_once() {
        let mut out = Vec::new();
        let mut teller = EventLineWriter::new(1, &mut out);
        let training = |episodes, saved| CellEvent::Training { episodes, timesteps: 10 * episodes, saved };
        for (episodes, saved) in [(0, 0), (1, 0), (2, 20), (3, 20)] {
            teller.write("a", training(episodes, saved));
        }
        let testing = |set: &str, episodes| CellEvent::Testing { set: set.into(), episodes };
        teller.write("a", testing("D", 1));
        teller.write("a", testing("R", 1));
        teller.write("b", testing("R", 1));
        let (_, time) = teller.last.get_mut("a").unwrap();
        *time = time.checked_sub(INTERVAL).unwrap();
        teller.write("a", testing("R", 2));
        teller.write("b", testing("R", 2));
        teller.write("a", CellEvent::Done);
        let words: Vec<String> = String::from_utf8(out).unwrap().lines().map(|line| line.replace('"', "")).collect();
        assert_eq!(
            words,
            [
                "{cell:a,event:training,episodes:0,timesteps:0,saved:0}",
                "{cell:a,event:training,episodes:2,timesteps:20,saved:20}",
                "{cell:a,event:testing,set:D,episodes:1}",
                "{cell:a,event:testing,set:R,episodes:1}",
                "{cell:b,event:testing,set:R,episodes:1}",
                "{cell:a,event:testing,set:R,episodes:2}",
                "{cell:a,event:done}",
            ]
        );
    }

    #[test]
    fn progress_is_sent_less_often_with_many_cells() {
        let seconds = |cells| EventLineWriter::new(cells, Vec::new()).interval.as_secs();
        assert_eq!([0, 1, 4, 36].map(seconds), [1, 1, 4, 10]);
    }

    #[test]
    fn a_file_is_read_line_by_line_while_it_is_written() {
        let mut out = tempfile::tempfile().unwrap();
        let (file, mut offset) = (out.try_clone().unwrap(), 0);
        let mut read =
            || read_lines(&file, &mut offset).unwrap().into_iter().map(|line| line.event).collect::<Vec<_>>();
        assert_eq!(read(), []);
        out.write_all(b"a prologue's words\n{\"cell\":\"a\",\"event\":\"busy\"}\n{\"cell\":\"a\",\"ev").unwrap();
        assert_eq!(read(), [CellEvent::Busy]);
        assert_eq!(read(), []);
        out.write_all(b"ent\":\"done\"}\n").unwrap();
        assert_eq!(read(), [CellEvent::Done]);
    }
}
