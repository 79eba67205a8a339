//! Stores a session's numbered replies until the session's client has certainly received them.

use super::lease::Error;
use std::collections::VecDeque;

/// The last replies of a session, numbered 1, 2, 3, …
pub struct ReplayBuffer<R> {
    last: u64,
    max_unanswered: usize,
    replies: VecDeque<R>,
}

impl<R> ReplayBuffer<R> {
    /// Makes an empty buffer. `max_unanswered`, at least 1, is the maximum number of unanswered requests of the client.
    pub fn new(max_unanswered: usize) -> Self {
        Self { last: 0, max_unanswered, replies: VecDeque::new() }
    }

    /// The number of the last reply.
    pub fn last(&self) -> u64 {
        self.last
    }

    /// Records that a request arrived. Including this request, at most `max_unanswered` requests of the client lack a
    /// reply. So the client has received all stored replies but the last `max_unanswered` - 1. Drops the received ones.
    pub fn on_request(&mut self) {
        let received = (self.replies.len() + 1).saturating_sub(self.max_unanswered);
        self.replies.drain(..received);
    }

    /// Stores the next reply.
    pub fn push_reply(&mut self, reply: R) {
        self.last += 1;
        self.replies.push_back(reply);
    }

    /// Iterates over the stored replies, oldest first.
    pub fn replies(&self) -> impl Iterator<Item = &R> {
        self.replies.iter()
    }

    /// Iterates mutably over the stored replies, oldest first.
    pub fn replies_mut(&mut self) -> impl Iterator<Item = &mut R> {
        self.replies.iter_mut()
    }

    /// Drops all stored replies.
    pub fn clear(&mut self) {
        self.replies.clear();
    }

    /// Checks that all replies after number `number` are stored.
    ///
    /// # Errors
    /// [`Error::NoReply`] if `number` is larger than the number of the last reply, [`Error::Forgotten`] if a reply
    /// after `number` has been dropped.
    pub fn check(&self, number: u64) -> Result<(), Error> {
        let (last, first) = (self.last, self.last - self.replies.len() as u64);
        if number > last {
            return Err(Error::NoReply { got: number, last });
        }
        if number < first {
            return Err(Error::Forgotten { got: number, first });
        }
        Ok(())
    }

    /// Returns the reply with this number, if it is stored.
    pub fn get_mut(&mut self, number: u64) -> Option<&mut R> {
        let behind = usize::try_from(self.last.checked_sub(number)?).ok()?;
        let place = self.replies.len().checked_sub(behind + 1)?;
        self.replies.get_mut(place)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn request_drops_the_replies_that_were_received() {
        let mut kept = ReplayBuffer::new(1);
        kept.on_request();
        kept.push_reply('a');
        assert_eq!((kept.check(0), kept.check(1), kept.get_mut(1)), (Ok(()), Ok(()), Some(&mut 'a')));
        assert_eq!(kept.check(2), Err(Error::NoReply { got: 2, last: 1 }));
        kept.on_request();
        assert_eq!(kept.check(0), Err(Error::Forgotten { got: 0, first: 1 }));
        assert_eq!(
            (kept.check(1), kept.get_mut(1)),
            (Ok(()), None),
            "the client has received reply 1, so it is not stored"
        );
        kept.push_reply('b');
        assert_eq!([1, 2, 3].map(|number| kept.get_mut(number).copied()), [None, Some('b'), None]);
        kept.clear();
        assert_eq!((kept.check(1), kept.check(2)), (Err(Error::Forgotten { got: 1, first: 2 }), Ok(())));
    }

    proptest! {
        /// A client with at most `max_unanswered` unanswered requests finds all replies that it has not received. The
        /// buffer never stores more than `max_unanswered` replies.
        #[test]
        fn unreceived_replies_stay_stored_within_the_limit(
            max_unanswered in 1_usize..8,
            moves in prop::collection::vec(0_u8..3, 0..200),
        ) {
            let mut kept = ReplayBuffer::new(max_unanswered);
            let (mut sent, mut received) = (0, 0);
            for what in moves {
                match what {
                    0 if sent - received < max_unanswered as u64 => sent += 1,
                    1 if kept.last() < sent => {
                        kept.on_request();
                        kept.push_reply(kept.last() + 1);
                    }
                    2 if received < kept.last() => received += 1,
                    _ => {}
                }
                prop_assert_eq!(kept.check(received), Ok(()));
                for mut number in received + 1..=kept.last() {
                    prop_assert_eq!(kept.get_mut(number), Some(&mut number));
                }
                let last = kept.last();
                prop_assert_eq!(kept.get_mut(last + 1), None);
                prop_assert!(kept.replies.len() <= max_unanswered);
                prop_assert!(kept.check(kept.last() + 1).is_err());
            }
        }
    }
}
