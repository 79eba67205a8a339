//! Audit of a policy by the servers' ledgers. A ledger records from which distributions each session drew the
//! parameters of its environments, with the environments' seeds and indices. The audit checks that the training drew
//! from the claimed distribution, and that it never drew from the policy's test sets.
//!
//! The audit first finds the training's sessions by the training's seed, and then the access tokens of these sessions.
//! The owners of these tokens may have learned from all parameters that were drawn with these tokens, in any session,
//! before the training ended.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

use perturb_protocol::ledger::{DrawEnd, DrawRecord, DrawStart, LedgerEntry, LedgerEvent, LedgerSession, Read, read};
use perturb_protocol::proto;
use perturb_protocol::region::Region;
use perturb_settings::Common;

use crate::records::{RecordedTest, Records};

/// The ledgers of one or several servers. Each line of a ledger has a digest that depends on all lines before it, and
/// all digests were verified.
#[derive(Debug, Default)]
pub struct Ledgers {
    heads: Vec<Head>,
    /// The draws of parameters, by environment.
    drawn: Vec<Drawn>,
    /// The state of the environments with the same session, seed and environment index.
    by_address: BTreeMap<(SessionId, u64, u32), EnvironmentAddress>,
    refused: Vec<Refused>,
    /// The end of each server process; `None` if it is unknown.
    process_ends: Vec<Option<Moment>>,
    /// The index of a contradictory line, the last one if there are several, and a description of the contradiction.
    defect: Option<(u64, &'static str)>,
}

/// The environments of a session that have the same seed and environment index. There are several if, for
/// example, trainings with the same seed share the session.
#[derive(Debug, Default)]
struct EnvironmentAddress {
    /// Indices in `drawn` of environments that are still in use.
    open: Vec<usize>,
    /// Recorded ends of draws that are not yet assigned to environments. They are assigned when there are as many ends
    /// as environments in `open`.
    ends: Vec<(Option<u64>, Moment)>,
    /// Indices in `drawn` of the environments that ended last.
    closed: Vec<usize>,
}

/// Maximum number of environments in a ledger's line. A line with more is refused.
const MAX_ENVS: u32 = 1 << 22;

/// The last line of a ledger.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Head {
    /// The path of the ledger.
    pub path: PathBuf,
    /// The number of lines.
    pub lines: u64,
    /// The digest of the last line.
    pub digest: String,
    /// The number of bytes after the last line. They are a line that is being written or was never completed.
    pub unfinished: u64,
}

/// The result of auditing one policy.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Proof {
    /// The names of the access tokens with which the training drew parameters. `None` stands for a session without a
    /// token. Empty if no ledger contains the training.
    pub tokens: BTreeSet<Option<String>>,
    /// The number of sessions of the training.
    pub sessions: usize,
    /// Descriptions of findings against the policy.
    pub against: Vec<String>,
    /// Descriptions of requests with the training's tokens that the servers refused before the training ended.
    pub refused: Vec<String>,
}

/// Identifies a session by two numbers: the index of its server process in [`Ledgers::process_ends`], and the session's
/// number in the ledger. The session's number alone is not enough, because every server process numbers its sessions
/// anew.
type SessionId = (usize, u64);

/// The position of a ledger's line, and the session that caused it.
#[derive(Debug, Clone)]
struct LedgerLine {
    at: Moment,
    session: SessionId,
    who: LedgerSession,
}

/// The time of a line. Lines of one ledger are ordered by their number `n`, and lines of different ledgers by
/// `unix_ms`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Moment {
    ledger: usize,
    n: u64,
    unix_ms: u64,
}

impl Moment {
    fn is_before(self, other: Self) -> bool {
        if self.ledger == other.ledger { self.n <= other.n } else { self.unix_ms <= other.unix_ms }
    }
}

/// The draws of an environment from one region of the parameter space.
#[derive(Debug)]
struct Drawn {
    line: Arc<LedgerLine>,
    seed: u64,
    index: u32,
    /// The index of the first episode.
    first: u64,
    /// The last episode that was drawn.
    last: LastDraw,
    /// The time at which the environment's last episode was recorded; `None` if it was not.
    ended: Option<Moment>,
    region: Arc<Region>,
}

/// The last episode that an environment began: `None` if it began no episode, otherwise the episode's index. `Unknown`
/// if the ledger does not record it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum LastDraw {
    None,
    Episode(u64),
    Unknown,
}

/// A request that the server refused: a session's request to draw parameters from a region of the parameter space.
#[derive(Debug)]
struct Refused {
    line: LedgerLine,
    region: Region,
    reason: String,
}

impl Ledgers {
    /// Reads ledgers and checks their digest chains. `known` are digests of lines that the user noted earlier. Each of
    /// them must occur in a ledger, otherwise the ledger was rewritten.
    ///
    /// # Errors
    /// A description of the first ledger that cannot be read or is not valid.
    pub fn read(paths: &[PathBuf], known: &[String]) -> Result<Self, String> {
        let (mut ledgers, mut missing) = (Self::default(), known.iter().collect::<Vec<_>>());
        for path in paths {
            let ledger = ledgers.heads.len();
            let read = read(path, |entry, digest| {
                missing.retain(|known| *known != digest);
                ledgers.take(ledger, entry);
            });
            let Read { chain, unfinished, .. } = read.map_err(|error| error.to_string())?;
            if let Some((n, what)) = ledgers.defect {
                return Err(format!("line {} of {} {what}", n + 1, path.display()));
            }
            if ledgers.heads.iter().any(|head| head.digest == chain.head()) {
                return Err(format!("{} was given twice, possibly under another name", path.display()));
            }
            ledgers.heads.push(Head {
                path: path.clone(),
                lines: chain.lines(),
                digest: chain.head().into(),
                unfinished,
            });
        }
        match missing.first() {
            Some(digest) => {
                Err(format!("no line has the digest {digest}: this is another ledger, or it was rewritten"))
            }
            None => Ok(ledgers),
        }
    }

    /// Returns the last line of each ledger.
    pub fn heads(&self) -> &[Head] {
        &self.heads
    }

    fn take(&mut self, ledger: usize, LedgerEntry { n, unix_ms, event }: LedgerEntry) {
        let at = Moment { ledger, n, unix_ms };
        if n == 0 && !matches!(event, LedgerEvent::Began { .. }) {
            self.defect = Some((n, "does not say that a server began"));
            return;
        }
        let process = self.process_ends.len().saturating_sub(1);
        let line = |who: LedgerSession| LedgerLine { at, session: (process, who.session), who };
        match event {
            LedgerEvent::Began { .. } => {
                // A server process started. The process that wrote to the same ledger before must have ended by now.
                if n > 0
                    && let Some(over) = self.process_ends.last_mut()
                {
                    over.get_or_insert(at);
                }
                self.process_ends.push(None);
            }
            LedgerEvent::Ended => self.process_ends.last_mut().into_iter().for_each(|over| *over = Some(at)),
            LedgerEvent::Refused { who, region, reason } => {
                self.refused.push(Refused { line: line(who), region, reason })
            }
            LedgerEvent::Draws(draws) => self.take_draws(line(draws.who.clone()), draws),
        }
    }

    /// Stores a record of draws. Handles `ends` first, because the environments in `ends` stopped drawing parameters
    /// before the environments in `begins` started.
    fn take_draws(&mut self, line: LedgerLine, DrawRecord { regions, begins, ends, .. }: DrawRecord) {
        let named = begins.iter().map(|begin| begin.count).chain(ends.iter().map(|end| end.count));
        if named.fold(0, u32::saturating_add) > MAX_ENVS {
            self.defect = Some((line.at.n, "names more environments than a session can have"));
            return;
        }
        for DrawEnd { seed, index, count, episode } in ends {
            for index in (0..count).map(|offset| index.saturating_add(offset)) {
                self.record_end((line.session, seed, index), (episode, line.at));
            }
        }
        let (line, regions) = (Arc::new(line), regions.into_iter().map(Arc::new).collect::<Vec<_>>());
        for DrawStart { seed, index, count, region, episode: first } in begins {
            let Some(region) = regions.get(region as usize) else {
                self.defect = Some((line.at.n, "names a region that it does not have"));
                return;
            };
            for index in (0..count).map(|offset| index.saturating_add(offset)) {
                self.by_address.entry((line.session, seed, index)).or_default().open.push(self.drawn.len());
                let (line, region) = (Arc::clone(&line), Arc::clone(region));
                self.drawn.push(Drawn { line, seed, index, first, last: LastDraw::Unknown, ended: None, region });
            }
        }
    }

    /// Records that an environment stopped drawing parameters. `end` has the environment's last episode and the time.
    /// The episode is `None` if nothing was drawn.
    fn record_end(&mut self, address: (SessionId, u64, u32), end: (Option<u64>, Moment)) {
        let address = self.by_address.entry(address).or_default();
        address.ends.push(end);
        // If no environment is in use, `end` corrects the previous ends: the environments that ended last had drawn
        // more episodes.
        let continued = address.open.is_empty();
        if address.ends.len() < address.open.len() {
            return;
        }
        if !continued {
            address.closed = std::mem::take(&mut address.open);
        }
        let ends = std::mem::take(&mut address.ends);
        let last = ends
            .iter()
            .map(|(episode, _)| episode.map_or(LastDraw::None, LastDraw::Episode))
            .max()
            .unwrap_or(LastDraw::None);
        for &which in &address.closed {
            let drawn = &mut self.drawn[which];
            drawn.last = if continued { drawn.last.max(last) } else { last };
            drawn.ended = Some(end.1);
        }
    }

    /// Audits a policy with its recorded tests. The policy was trained for `episodes` episodes in `environment` with
    /// the settings `training`.
    pub fn prove(
        &self,
        training: &Common,
        episodes: u64,
        environment: &proto::Environment,
        records: &Records,
    ) -> Proof {
        let claimed = training.training_set("").region(environment);
        // Regions of many contexts are equal far more quickly than each is within the other.
        let is_claimed =
            |region: &Region| *region == claimed || (region.is_within([&claimed]) && claimed.is_within([region]));
        // A training with the same seed but another parameter distribution is a different training.
        let is_own = |drawn: &&Drawn| {
            drawn.line.who.environment == environment.name
                && drawn.last != LastDraw::None
                && drawn.seed == training.seed
                && (drawn.index as usize) < training.num_envs
                && is_claimed(&drawn.region)
        };
        // Finds the draws of the training, its sessions and its tokens. Compares the number of drawn episodes with
        // `episodes`.
        let own: Vec<&Drawn> = self.drawn.iter().filter(is_own).collect();
        let sessions: BTreeSet<SessionId> = own.iter().map(|drawn| drawn.line.session).collect();
        let tokens = own.iter().map(|drawn| drawn.line.who.token.clone()).collect();
        let mut proof = Proof { tokens, sessions: sessions.len(), ..Proof::default() };
        let drawn = own.iter().map(|drawn| drawn.episodes()).fold(0, u64::saturating_add);
        if drawn < episodes || own.is_empty() {
            let name =
                format!("{}, seed {}, trained on {}", training.environment, training.seed, training.trained_on());
            let few = format!(
                "the ledgers record only {drawn} of the {episodes} episodes of its training ({name}): pass the ledgers \
                 of all servers"
            );
            proof.against.push(few);
        }
        // If the end of an environment's draws is not recorded, the training may have lasted until its server process
        // ended.
        let end = |drawn: &&Drawn| drawn.ended.or(self.process_ends.get(drawn.line.session.0).copied().flatten());
        let ends: Vec<Option<Moment>> = own.iter().map(end).collect();
        let is_by_owner = |line: &LedgerLine| {
            line.who.environment == environment.name
                && proof.tokens.contains(&line.who.token)
                && ends.iter().any(|end| end.is_none_or(|end| line.at.is_before(end)))
        };
        // Finds draws from the test sets that were made with the training's tokens before the training ended.
        for test in &records.about.tests {
            let set = &test.set.name;
            let others = test_regions(environment, test, &claimed);
            let overlaps = |region: &Region| others.iter().any(|other| other.overlaps(region));
            let mut reported: Option<Moment> = None;
            for drawn in self.drawn.iter().filter(|drawn| drawn.last != LastDraw::None && is_by_owner(&drawn.line)) {
                let what = if reported == Some(drawn.line.at) {
                    continue;
                } else if drawn.has_episode(test, records) {
                    format!("episodes of the test on {set}")
                } else if !drawn.region.is_within([&claimed]) && overlaps(&drawn.region) {
                    format!("{}, of the test set {set},", drawn.region)
                } else {
                    continue;
                };
                let what = format!("{what} had been drawn before the training ended");
                proof.against.push(self.sentence(&drawn.line, &what));
                reported = Some(drawn.line.at);
            }
        }
        let refused = self.refused.iter().filter(|refused| is_by_owner(&refused.line));
        let refused =
            refused.map(|Refused { line, region, reason }| self.sentence(line, &format!("{region} refused: {reason}")));
        proof.refused = refused.collect();
        proof
    }

    fn sentence(&self, line: &LedgerLine, what: &str) -> String {
        let LedgerLine { at: Moment { ledger, n, unix_ms }, who, .. } = line;
        let path = self.heads.get(*ledger).map(|head| head.path.display().to_string()).unwrap_or_default();
        let mut sentence = format!("line {} of {path}: {what}", n + 1);
        let token = who.token.as_ref().map_or("without a token".into(), |token| format!("by the token {token:?}"));
        // Writing to a string cannot fail.
        let _ = write!(sentence, ", {token}, {} s after 1970", unix_ms / 1000);
        sentence
    }
}

/// Returns the parameter region of each context of a test. Omits regions that lie inside `claimed`, the region of the
/// training.
fn test_regions(environment: &proto::Environment, test: &RecordedTest, claimed: &Region) -> Vec<Region> {
    let of = |context| Region::from_version(environment, test.set.version, &test.set.parameters(context));
    test.set.listed().iter().map(of).filter(|region| !region.is_within([claimed])).collect()
}

impl Drawn {
    /// Returns the number of episodes that were drawn, or the maximum of u64 if it is unknown.
    fn episodes(&self) -> u64 {
        match self.last {
            LastDraw::None => 0,
            // The number is `last` - `first` + 1, or 0 if `last` is before `first`.
            LastDraw::Episode(last) => last.saturating_sub(self.first).saturating_add(u64::from(last >= self.first)),
            LastDraw::Unknown => u64::MAX,
        }
    }

    /// Returns whether the environment may have drawn a recorded episode of `test`.
    fn has_episode(&self, test: &RecordedTest, records: &Records) -> bool {
        let may = |episode: u64| match self.last {
            LastDraw::None => false,
            LastDraw::Episode(last) => (self.first..=last).contains(&episode),
            LastDraw::Unknown => self.first <= episode,
        };
        let recorded = records.episodes.iter().filter(|record| record.set == test.set.name && record.seed == test.seed);
        self.seed == test.seed
            && recorded.filter(|record| record.environment_index == self.index).any(|record| may(record.episode_index))
    }
}
