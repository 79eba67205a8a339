//! What servers' ledgers prove of a policy: that its training drew from what it says, and never from its test sets.
//!
//! Who trained is known by tokens: the names under which the training's seed was drawn. Whatever these drew before the
//! training's end may have been learned from, in whichever session.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

use perturb_protocol::ledger::{Begin, Draws, End, Entry, Event, Who, read};
use perturb_protocol::proto;
use perturb_protocol::region::Region;

use crate::records::{RecordedTest, Records};
use crate::settings::Common;

/// Ledgers of one or several servers, whose chains hold.
#[derive(Debug, Default)]
pub struct Ledgers {
    heads: Vec<Head>,
    drawn: Vec<Drawn>,
    ended: Vec<Ended>,
    refused: Vec<Refused>,
    /// When each beginning of each server was over, whether or not it said so, ms.
    over: Vec<u64>,
    /// A line that contradicts itself.
    defect: Option<u64>,
}

/// Where a ledger ends now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Head {
    /// Its file.
    pub path: PathBuf,
    /// Lines.
    pub lines: u64,
    /// The last one's digest.
    pub digest: String,
}

/// What was found of one policy.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Proof {
    /// Under which tokens' names its training drew, `None` where none was needed; empty if no ledger has it.
    pub tokens: BTreeSet<Option<String>>,
    /// Sessions of its training.
    pub sessions: usize,
    /// What speaks against it, each in a sentence.
    pub against: Vec<String>,
    /// What its tokens were refused until its end, each in a sentence.
    pub refused: Vec<String>,
}

/// A session: which beginning of which server, and its number there.
type Session = (usize, u64);

/// Where a line stands.
#[derive(Debug, Clone)]
struct Line {
    ledger: usize,
    n: u64,
    unix_ms: u64,
    session: Session,
    who: Who,
}

/// Environments that began to draw.
#[derive(Debug)]
struct Drawn {
    line: Line,
    begin: Begin,
    region: Arc<Region>,
}

/// How far environments had come.
#[derive(Debug)]
struct Ended {
    session: Session,
    unix_ms: u64,
    end: End,
}

/// What a session wanted to draw from.
#[derive(Debug)]
struct Refused {
    line: Line,
    region: Region,
    reason: String,
}

impl Ledgers {
    /// Reads ledgers and checks their chains. Each digest that is `known` from elsewhere must be one of a line.
    ///
    /// # Errors
    /// In a sentence, the first that cannot be read or believed.
    pub fn read(paths: &[PathBuf], known: &[String]) -> Result<Self, String> {
        let (mut ledgers, mut missing) = (Self::default(), known.iter().collect::<Vec<_>>());
        for path in paths {
            let ledger = ledgers.heads.len();
            let read = read(path, |entry, digest| {
                missing.retain(|known| *known != digest);
                ledgers.take(ledger, entry);
            });
            let chain = read.map_err(|error| error.to_string())?.chain;
            if let Some(n) = ledgers.defect {
                return Err(format!("line {} of {} names a region that it does not have", n + 1, path.display()));
            }
            ledgers.heads.push(Head { path: path.clone(), lines: chain.lines(), digest: chain.head().into() });
        }
        match missing.first() {
            Some(digest) => Err(format!("no line has the digest {digest}: the ledger is another, or was written anew")),
            None => Ok(ledgers),
        }
    }

    /// Where each of them ends now.
    pub fn heads(&self) -> &[Head] {
        &self.heads
    }

    fn take(&mut self, ledger: usize, Entry { n, unix_ms, event }: Entry) {
        let beginning = self.over.len().saturating_sub(1);
        let line = |who: Who| Line { ledger, n, unix_ms, session: (beginning, who.session), who };
        match event {
            Event::Began { .. } => {
                // The one before it, of the same ledger, ended by then.
                if n > 0
                    && let Some(over) = self.over.last_mut()
                {
                    *over = unix_ms.min(*over);
                }
                self.over.push(u64::MAX);
            }
            Event::Ended => self.over.last_mut().into_iter().for_each(|over| *over = unix_ms),
            Event::Refused { who, region, reason } => self.refused.push(Refused { line: line(who), region, reason }),
            Event::Draws(Draws { who, regions, begins, ends }) => {
                let line = line(who);
                let ended = |end| Ended { session: line.session, unix_ms, end };
                self.ended.extend(ends.into_iter().map(ended));
                let regions: Vec<Arc<Region>> = regions.into_iter().map(Arc::new).collect();
                for begin in begins {
                    match regions.get(begin.region as usize) {
                        Some(region) => {
                            self.drawn.push(Drawn { line: line.clone(), region: Arc::clone(region), begin })
                        }
                        None => self.defect = Some(n),
                    }
                }
            }
        }
    }

    /// What they say of a policy that was trained in an environment as `training` says, for so many episodes, and of its
    /// recorded tests.
    pub fn prove(
        &self,
        training: &Common,
        episodes: u64,
        environment: &proto::Environment,
        records: &Records,
    ) -> Proof {
        let claimed = Region::of(environment, training.version, &training.parameters);
        // Other trainings with its seed, on something else, are told by what they draw from.
        let is_own = |drawn: &&Drawn| {
            let Begin { seed, index, .. } = drawn.begin;
            drawn.line.who.environment == environment.name
                && seed == training.seed
                && (index as usize) < training.num_envs
                && drawn.region.is_within([&claimed])
                && claimed.is_within([&*drawn.region])
        };
        let own: Vec<&Drawn> = self.drawn.iter().filter(is_own).collect();
        let sessions: BTreeSet<Session> = own.iter().map(|drawn| drawn.line.session).collect();
        let tokens = own.iter().map(|drawn| drawn.line.who.token.clone()).collect();
        let mut proof = Proof { tokens, sessions: sessions.len(), ..Proof::default() };
        let drawn = own.iter().map(|drawn| self.episodes(drawn)).fold(0, u64::saturating_add);
        if drawn < episodes || own.is_empty() {
            let name =
                format!("{}, seed {}, trained on {}", training.environment, training.seed, training.trained_on());
            let few =
                format!("of the {episodes} episodes of its training, {name}, {drawn} were drawn: give all ledgers");
            proof.against.push(few);
        }
        let end = sessions.iter().map(|session| self.end(*session, training.seed)).max().unwrap_or_default();
        let is_its = |line: &Line| {
            line.who.environment == environment.name && line.unix_ms <= end && proof.tokens.contains(&line.who.token)
        };
        for test in &records.about.tests {
            let set = &test.set.name;
            let others = tested(environment, test, &claimed);
            let overlaps = |region: &Region| others.iter().any(|other| other.overlaps(region));
            for drawn in self.drawn.iter().filter(|drawn| is_its(&drawn.line)) {
                let what = if self.has_episode(drawn, test, records) {
                    format!("episodes of the test on {set}")
                } else if !drawn.region.is_within([&claimed]) && overlaps(&drawn.region) {
                    format!("{}, of the test set {set},", drawn.region)
                } else {
                    continue;
                };
                let what = format!("{what} had been drawn before the training ended");
                proof.against.push(self.sentence(&drawn.line, &what));
            }
        }
        let refused = self.refused.iter().filter(|refused| is_its(&refused.line));
        let refused =
            refused.map(|Refused { line, region, reason }| self.sentence(line, &format!("{region} refused: {reason}")));
        proof.refused = refused.collect();
        proof
    }

    /// How many episodes environments drew, as far as it is known.
    fn episodes(&self, drawn: &Drawn) -> u64 {
        let Begin { index, count, episode, .. } = drawn.begin;
        let each = (0..count).map(|offset| match self.last(drawn, index.saturating_add(offset)) {
            Some(last) => (last + 1).saturating_sub(episode),
            None => u64::MAX, // its session did not end
        });
        each.fold(0, u64::saturating_add)
    }

    /// The last episode that an environment of those had begun when its session was seen last.
    fn last(&self, drawn: &Drawn, of: u32) -> Option<u64> {
        let its = self.ended.iter().filter(|ended| {
            let End { seed, index, count, .. } = ended.end;
            ended.session == drawn.line.session && seed == drawn.begin.seed && covers(index, count, of)
        });
        its.map(|ended| ended.end.episode).max()
    }

    /// When a session had drawn the last episode with a seed, ms.
    fn end(&self, session: Session, seed: u64) -> u64 {
        let its = self.ended.iter().filter(|ended| ended.session == session && ended.end.seed == seed);
        its.map(|ended| ended.unix_ms).max().unwrap_or(self.over.get(session.0).copied().unwrap_or(u64::MAX))
    }

    /// Whether environments may have drawn a recorded episode of a test.
    fn has_episode(&self, drawn: &Drawn, test: &RecordedTest, records: &Records) -> bool {
        let Begin { seed, index, count, episode, .. } = drawn.begin;
        if seed != test.seed {
            return false;
        }
        let its = records.episodes.iter().filter(|record| record.set == test.set.name && record.seed == seed);
        its.filter(|record| covers(index, count, record.environment_index)).any(|record| {
            let last = self.last(drawn, record.environment_index).unwrap_or(u64::MAX);
            (episode..=last).contains(&record.episode_index)
        })
    }

    fn sentence(&self, line: &Line, what: &str) -> String {
        let Line { ledger, n, unix_ms, who, .. } = line;
        let path = self.heads.get(*ledger).map(|head| head.path.display().to_string()).unwrap_or_default();
        let mut sentence = format!("line {} of {path}: {what}", n + 1);
        let token = who.token.as_ref().map_or("without a token".into(), |token| format!("by the token {token:?}"));
        // A string takes it.
        let _ = write!(sentence, ", {token}, {} s after 1970", unix_ms / 1000);
        sentence
    }
}

/// What a test draws from, context by context, where that is not what the training draws from, too.
fn tested(environment: &proto::Environment, test: &RecordedTest, claimed: &Region) -> Vec<Region> {
    let of = |context| Region::of(environment, test.set.version, &test.set.parameters(context));
    test.set.listed().iter().map(of).filter(|region| !region.is_within([claimed])).collect()
}

fn covers(first: u32, count: u32, index: u32) -> bool {
    index.checked_sub(first).is_some_and(|offset| offset < count)
}
