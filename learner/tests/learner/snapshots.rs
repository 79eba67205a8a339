//! Snapshots that are too long for one message are taken and restored in parts.

use bytes::Bytes;
use perturb_learner::client::{ClientSession, OpenOptions, PrivateServer, StepReply};
use perturb_protocol::{Distribution, Interval, Version};
use rstest::rstest;

use crate::common::{connect, options, server};

/// gRPC's default limit of a received message, bytes.
const GRPC_LIMIT: usize = 4 << 20;
/// A server's default limit of a request, bytes.
const REQUEST_LIMIT: usize = 64 << 20;

/// CartPoles with snapshots of some 12 kB: twelve distributions of 64 intervals each.
fn long_snapshots(num_envs: usize) -> OpenOptions {
    let intervals = |low: f64, high: f64| {
        let at = |i: u8| low + (high - low) * f64::from(i) / 128.0;
        let intervals: Vec<Interval> = (0..64).map(|i| Interval::new(at(2 * i), at(2 * i + 1))).collect();
        Distribution::union(&intervals).expect("64 intervals")
    };
    let of_physics = [("force", 5.0, 10.0), ("length", 0.3, 0.7), ("mass", 0.1, 0.2)];
    let of_disturbances = [
        ("action_hold", 0.0, 0.2),
        ("change_probability", 0.0, 0.1),
        ("changed_force", 5.0, 10.0),
        ("changed_length", 0.3, 0.7),
        ("changed_mass", 0.1, 0.2),
        ("push", 0.1, 0.2),
        ("push_interval", 10.0, 90.0),
        ("sensor_dropout", 0.0, 0.1),
        ("sensor_noise", 0.0, 0.1),
    ];
    let of_all = of_physics.into_iter().chain(of_disturbances);
    let parameters = of_all.map(|(name, low, high)| (name.to_owned(), intervals(low, high))).collect();
    OpenOptions { parameters, version: Version::D, ..options("CartPole", num_envs, 1) }
}

fn bytes_after(session: &mut ClientSession<'_>, actions: &[u8]) -> Vec<Vec<f32>> {
    let mut reply = StepReply::default();
    (0..3)
        .map(|_| {
            session.step(actions, &mut reply).expect("a step");
            [reply.observations.as_slice(), &reply.rewards].concat()
        })
        .collect()
}

#[rstest]
#[case::above_the_limit_of_grpc(options("Hopper", 8500, 1), 12, GRPC_LIMIT, 1)]
#[case::above_the_limit_of_a_request(long_snapshots(5600), 4, REQUEST_LIMIT, 1)]
#[case::above_the_limits_of_two_requests(long_snapshots(11_200), 4, 2 * REQUEST_LIMIT, 2)]
fn long_snapshots_are_followed_by_the_same_bytes(
    #[case] options: OpenOptions,
    #[case] action_bytes: usize,
    #[case] limit: usize,
    #[case] n_servers: usize,
) {
    let servers: Vec<PrivateServer> = (0..n_servers).map(|_| server()).collect();
    let servers = connect(&servers);
    let mut observations = Vec::new();
    let mut session = ClientSession::open(&servers, &options, &mut observations).expect("a session");
    let (n, actions) = (options.num_envs, vec![0; options.num_envs * action_bytes]);
    bytes_after(&mut session, &actions);
    let saved = session.snapshot(0..n).expect("snapshots");
    assert!(saved.iter().map(Bytes::len).sum::<usize>() > limit);
    let expected = bytes_after(&mut session, &actions);
    session.restore(0..n, &saved).expect("restored environments");
    assert!(session.snapshot(0..n).expect("snapshots") == saved);
    assert!(bytes_after(&mut session, &actions) == expected);
    // Restores some of the environments: on one side of the border between two servers, and across it.
    for slots in [0..2, n / 2 - 1..n / 2 + 1, n - 2..n] {
        session.restore(slots.clone(), &saved[slots.clone()]).expect("restored environments");
        assert!(session.snapshot(slots.clone()).expect("snapshots") == saved[slots]);
    }
}
