//! Trainings that act here, in lockstep over one session.
//!
//! Every training has its own weights, randomness, logs and checkpoint, and its own slots of the session, so that its
//! bytes are those that it has alone.

use std::ops::Range;
use std::time::{Duration, Instant};

use super::learning::{Learning, keep_alive};
use super::{Outcome, Result, TrainError};
use crate::client::{Servers, Session, StepReply};
use crate::logging::Progress;
use crate::policy::Room;
use crate::rollout::Collector;
use perturb_study::interrupt::StopFlag;

/// Trainings over one session.
pub(super) struct Lockstep<'a> {
    session: Session<'a>,
    seats: Vec<Seat<'a>>,
    /// Whether they take their turns in reverse order, until all have learned.
    backwards: bool,
    actions: Vec<u8>,
    reply: StepReply,
    times: Times,
    /// Where feed-forward policies learn, if there are several.
    room: Option<Room>,
}

/// Where the time went since the beginning.
#[derive(Clone, Copy, Debug, Default)]
struct Times {
    acting: Duration,
    waiting: Duration,
}

/// One of the trainings.
pub(super) struct Seat<'a> {
    /// Among those that were begun together.
    index: usize,
    slots: Range<usize>,
    collector: Collector,
    learning: Learning<'a>,
    /// A rollout has begun, …
    collecting: bool,
    /// … at these times.
    begun: Times,
    /// What has not been told yet.
    learned: Option<Progress>,
    end: Option<Result<Outcome>>,
}

impl<'a> Lockstep<'a> {
    /// `seats` have the session's slots, in order.
    ///
    /// # Errors
    /// A room for gradients that cannot be had.
    pub(super) fn new(session: Session<'a>, seats: Vec<Seat<'a>>) -> Result<Self> {
        let room = if let [first, _, ..] = seats.as_slice() { first.learning.room()? } else { None };
        let (reply, times) = (StepReply::default(), Times::default());
        Ok(Self { session, seats, backwards: false, actions: Vec::new(), reply, times, room })
    }

    /// Trains until every training has ended, and tells how each did.
    ///
    /// # Errors
    /// The session's. Trainings that have not ended by then can go on from their checkpoints.
    pub(super) fn run(
        mut self,
        servers: &Servers,
        stop: &StopFlag,
        report: &mut dyn FnMut(usize, &Progress),
        ended: &mut dyn FnMut(usize, Result<Outcome>),
    ) -> Result<()> {
        while !self.seats.is_empty() {
            let advanced = self.advance(servers, stop, report);
            let mut left = Vec::new();
            while let Some(place) = self.seats.iter().position(|seat| seat.end.is_some()) {
                let seat = self.seats.remove(place);
                seat.end.into_iter().for_each(|end| ended(seat.index, end));
                left.push(seat.slots);
            }
            if let Err(error) = advanced {
                return Err(match self.seats.as_slice() {
                    [alone] => alone.learning.failed(error),
                    _ => error,
                });
            }
            left.into_iter().rev().try_for_each(|slots| self.release(slots))?; // from the back: those before stay
        }
        Ok(())
    }

    /// A step of all environments, and the updates that follow.
    fn advance(&mut self, servers: &Servers, stop: &StopFlag, report: &mut dyn FnMut(usize, &Progress)) -> Result<()> {
        let Self { session, seats, backwards, actions, reply, times, room } = self;
        let start = Instant::now();
        for seat in in_order(seats, *backwards) {
            let acted = seat.act(session, *times);
            seat.settle(acted)?;
        }
        actions.clear();
        // Of one that has failed: for the last time, and nobody sees what comes of it.
        seats.iter().for_each(|seat| actions.extend_from_slice(seat.collector.player().actions()));
        let sent = Instant::now();
        session.step(actions, reply)?;
        let came = Instant::now();
        times.waiting += came - sent;
        for seat in seats.iter_mut().filter(|seat| seat.end.is_none()) {
            let taken = seat.take(reply);
            seat.settle(taken)?;
        }
        times.acting += (sent - start) + came.elapsed();
        let due = |seat: &Seat<'_>| seat.end.is_none() && seat.collector.is_done();
        let expected = seats.iter().filter(|seat| due(seat)).map(|seat| seat.learning.last_update()).sum();
        let learning = seats.iter().any(due);
        keep_alive(servers, expected, || {
            for seat in in_order(seats, *backwards).filter(|seat| due(seat)) {
                let learned = seat.learn(room.as_mut(), *times);
                seat.settle(learned)?;
            }
            Ok::<(), TrainError>(())
        })?;
        // Who has learned last comes first: the processor's caches, too small for all, still have what it needs.
        *backwards ^= learning;
        for seat in seats.iter_mut() {
            if let Some(progress) = seat.learned.take() {
                let concluded = seat.conclude(session, progress, stop, report);
                seat.settle(concluded)?;
            }
        }
        Ok(())
    }

    /// Gives slots back that no training has any more.
    ///
    /// # Errors
    /// The session's.
    pub(super) fn release(&mut self, slots: Range<usize>) -> Result<()> {
        if self.seats.is_empty() {
            return Ok(()); // the session is closed as a whole
        }
        self.session.release(slots.clone())?;
        for seat in self.seats.iter_mut().filter(|seat| seat.slots.start >= slots.end) {
            seat.slots = seat.slots.start - slots.len()..seat.slots.end - slots.len();
        }
        Ok(())
    }
}

fn in_order<'s, 'a>(seats: &'s mut [Seat<'a>], backwards: bool) -> impl Iterator<Item = &'s mut Seat<'a>> {
    let mut seats = seats.iter_mut();
    std::iter::from_fn(move || if backwards { seats.next_back() } else { seats.next() })
}

impl<'a> Seat<'a> {
    /// Training number `index` in `slots` of the session.
    pub(super) fn new(index: usize, slots: Range<usize>, collector: Collector, learning: Learning<'a>) -> Self {
        Self { index, slots, collector, learning, collecting: false, begun: Times::default(), learned: None, end: None }
    }

    /// Chooses actions, at the beginning of a rollout if none is being collected.
    fn act(&mut self, session: &mut Session<'_>, times: Times) -> Result<()> {
        if !self.collecting {
            (self.collecting, self.begun) = (true, times);
            let until = self.learning.collect_until();
            let (rollout, _) = self.learning.collecting();
            let slots = self.slots.clone();
            let reset = |observations: &mut [f32]| session.reset(slots, observations);
            self.collector.begin(until, rollout, reset)?;
        }
        self.collector.act()?;
        Ok(())
    }

    /// Takes what came of the actions.
    fn take(&mut self, reply: &StepReply) -> Result<()> {
        let (rollout, tally) = self.learning.collecting();
        let slice = reply.slice(self.slots.clone());
        self.collector.take(&slice, rollout, |episode| tally.note(episode))?;
        if self.collector.is_done() {
            self.collector.finish(rollout)?;
        }
        Ok(())
    }

    /// Learns from the rollout.
    fn learn(&mut self, room: Option<&mut Room>, now: Times) -> Result<()> {
        self.collecting = false;
        let (acting, waiting) = (now.acting - self.begun.acting, now.waiting - self.begun.waiting);
        let player = Some(self.collector.player_mut());
        self.learned = Some(match room {
            Some(room) => self.learning.learn_in(room, player, acting, waiting)?,
            None => self.learning.learn(player, acting, waiting)?,
        });
        Ok(())
    }

    /// Logs what was learned, and writes a checkpoint if one is due.
    fn conclude(
        &mut self,
        session: &mut Session<'_>,
        progress: Progress,
        stop: &StopFlag,
        report: &mut dyn FnMut(usize, &Progress),
    ) -> Result<()> {
        report(self.index, &progress);
        let Self { learning, collector, slots, .. } = self;
        let turn = learning.turn(progress, stop)?;
        let player = collector.player();
        learning.keep(&turn, player.normalisers())?;
        if let (true, Some(state)) = (turn.save, player.state()) {
            learning.save(session.snapshot(slots.clone())?, state, player.normalisers().clone())?;
        }
        if turn.ends {
            self.end = Some(learning.end(&turn));
        }
        Ok(())
    }

    /// An error ends this training, but for one of the session, which ends all.
    fn settle(&mut self, result: Result<()>) -> Result<()> {
        match result {
            Err(error @ TrainError::Client(_)) => return Err(error),
            Err(error) => self.end = Some(Err(self.learning.failed(error))),
            Ok(()) => {}
        }
        Ok(())
    }
}
