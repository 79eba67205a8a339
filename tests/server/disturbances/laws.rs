//! The exact law of each disturbance, tested with an environment that observes the actions that reach it.

use super::{disturbed, echo};
use crate::common::observe;
use perturb::env::{Action, Draw, DrawPurpose, Episodes, PhiloxStream, Version};
use std::sync::Arc;

/// The number of draws for the test of a distribution.
const DRAWS: u32 = 100_000;
/// The bound of √n times the largest difference of two distribution functions. 999 of 1000 samples are below it
/// (Kolmogorov). The samples in these tests are always the same.
const MAX_KOLMOGOROV: f64 = 1.95;
/// The number of standard deviations within which a count of successes lies in more than 9999 of 10 000 samples.
const MAX_DEVIATIONS: f64 = 4.0;
/// The neutral action of each motor: 0, or the end of its range that is nearest to 0.
const NEUTRAL: [f32; 2] = [0.0, 0.5];
const ADDRESS: (u64, u32) = (5, 9);

fn echo(values: &[(&str, f64)]) -> Episodes {
    disturbed(&echo::SPEC, Version::D, values, ADDRESS)
}

/// Returns the action of step `t`, different for every step.
fn action(t: u32) -> [f32; 2] {
    [t as f32 + 1.0, -(t as f32) - 2.0]
}

/// Takes `steps` steps. Returns the action that reached the environment in each.
fn acted(episodes: &mut Episodes, steps: u32, action: impl Fn(u32) -> [f32; 2]) -> Vec<[f32; 2]> {
    let mut terms = [0.0];
    let step = |t| {
        episodes.step(Action::Continuous(&action(t)), &mut terms);
        let seen = observe(episodes);
        [seen[0], seen[1]]
    };
    (0..steps).map(step).collect()
}

/// Returns the random stream of a step of the first episode.
fn stream(purpose: DrawPurpose, step: u32) -> PhiloxStream {
    let draw = Draw { seed: ADDRESS.0, environment_index: ADDRESS.1, episode_index: 0 };
    PhiloxStream::at_step(&draw, purpose, step)
}

/// Returns the first normal numbers of the stream of a step of the first episode.
fn normals<const N: usize>(purpose: DrawPurpose, step: u32) -> [f64; N] {
    let mut stream = stream(purpose, step);
    std::array::from_fn(|_| stream.normal())
}

/// Asserts that a sample is from the normal distribution with this mean and standard deviation.
fn assert_normal(sample: Vec<f64>, mean: f64, deviation: f64) {
    assert_distributed(sample, |x| 0.5 * libm::erfc(-(x - mean) / (deviation * std::f64::consts::SQRT_2)));
}

/// Asserts that a sample is from the uniform distribution on [0, 1].
fn assert_uniform(sample: Vec<f64>) {
    assert_distributed(sample, |x| x.clamp(0.0, 1.0));
}

/// Asserts that a sample is from the distribution with this distribution function.
fn assert_distributed(mut sample: Vec<f64>, expected: impl Fn(f64) -> f64) {
    sample.sort_by(f64::total_cmp);
    let n = sample.len() as f64;
    let distance = |(i, &x): (usize, &f64)| {
        let (below, at) = (i as f64 / n, (i + 1) as f64 / n);
        (expected(x) - below).abs().max((at - expected(x)).abs())
    };
    let largest = sample.iter().enumerate().map(distance).fold(0.0, f64::max);
    assert!(largest * n.sqrt() < MAX_KOLMOGOROV, "{}", largest * n.sqrt());
}

/// Asserts that the count `count` among `n` events is plausible for this probability.
fn assert_frequency(count: usize, n: usize, probability: f64) {
    let (expected, deviation) = (n as f64 * probability, (n as f64 * probability * (1.0 - probability)).sqrt());
    let deviations = (count as f64 - expected) / deviation;
    assert!(deviations.abs() < MAX_DEVIATIONS, "{count} of {n}, {deviations} deviations from {expected}");
}

/// The result of `numpy.random.Generator(Philox(key=[5, 9], counter=[0, 3, 4, 7])).standard_normal(10**6)` in NumPy
/// 2.4: the first four numbers, the last number, and the sum.
const NUMPY: ([f64; 4], f64, f64) = (
    [1.3611326763840133, -1.7000479093337983, 0.7246232653554274, -1.43594102052377],
    0.24873658710877308,
    910.3647237267187,
);

#[test]
fn normal_numbers_are_those_of_numpy() {
    let draw = Draw { seed: ADDRESS.0, environment_index: ADDRESS.1, episode_index: 3 };
    let mut stream = PhiloxStream::at_step(&draw, DrawPurpose::SensorNoise, 7);
    let numbers: Vec<f64> = (0..1_000_000).map(|_| stream.normal()).collect();
    let (first, last, sum) = NUMPY;
    // Each number may differ by a relative 1e-13 from rounding. If NumPy rejected a draw that
    // this code accepts, all later numbers would differ.
    let is_near = |a: f64, b: f64| (a - b).abs() < 1e-11;
    assert!(numbers.iter().zip(first).all(|(&a, b)| is_near(a, b)), "{:?}", &numbers[..4]);
    assert!(is_near(numbers[numbers.len() - 1], last), "{}", numbers[numbers.len() - 1]);
    assert!((numbers.iter().sum::<f64>() - sum).abs() < 1e-6);
    // Numbers in the tail, beyond 3.65, are drawn by another method. Some of them occur.
    assert!((200..400).contains(&numbers.iter().filter(|number| number.abs() > 3.65).count()));
    assert_normal(numbers, 0.0, 1.0);
}

#[test]
fn groups_of_normal_numbers_equal_single_ones() {
    let (mut singles, mut groups) = (stream(DrawPurpose::SensorNoise, 1), stream(DrawPurpose::SensorNoise, 1));
    // Groups of one to four numbers begin at every place of a block, and rejected numbers move these places.
    for _ in 0..20_000 {
        let mut numbers = Vec::with_capacity(14);
        numbers.extend(groups.normals::<4>());
        numbers.extend(groups.normals::<1>());
        numbers.extend(groups.normals::<4>());
        numbers.extend(groups.normals::<3>());
        numbers.extend(groups.normals::<2>());
        for number in numbers {
            assert_eq!(number.to_bits(), singles.normal().to_bits());
        }
    }
}

#[test]
fn skipped_numbers_are_those_that_would_be_drawn() {
    for n in 0..10 {
        let (mut drawn, mut skipped) = (stream(DrawPurpose::Push, 1), stream(DrawPurpose::Push, 1));
        drawn.unit();
        skipped.unit();
        for _ in 0..n {
            drawn.unit();
        }
        skipped.skip(n);
        assert_eq!(drawn.unit().to_bits(), skipped.unit().to_bits(), "{n} numbers");
    }
}

#[test]
fn late_actions_act_after_the_delay() {
    let acted = acted(&mut echo(&[("action_delay", 3.0)]), 20, action);
    assert_eq!(acted[..3], [NEUTRAL; 3]);
    assert_eq!(acted[3..], (0..17).map(action).collect::<Vec<_>>());
}

#[test]
fn held_actions_act_again() {
    const PROBABILITY: f64 = 0.3;
    let acted = acted(&mut echo(&[("action_hold", PROBABILITY)]), DRAWS, action);
    assert_eq!(acted[0], action(0), "there is no action to hold yet");
    let is_held: Vec<bool> = (1..DRAWS).map(|t| acted[t as usize] == acted[t as usize - 1]).collect();
    for (t, &is_held) in (1..DRAWS).zip(&is_held) {
        assert_eq!(is_held, stream(DrawPurpose::ActionHold, t).unit() < PROBABILITY, "step {t}");
        assert!(is_held || acted[t as usize] == action(t), "step {t}");
    }
    assert_frequency(is_held.iter().filter(|is_held| **is_held).count(), is_held.len(), PROBABILITY);
}

#[test]
fn noise_on_actions_is_normal_and_a_share_of_the_range() {
    let acted = acted(&mut echo(&[("action_noise", 0.1)]), DRAWS, |_| [0.25, 1.0]);
    for (t, acted) in (0..DRAWS).zip(&acted) {
        let [left, right] = normals(DrawPurpose::ActionNoise, t);
        assert_eq!(*acted, [(0.25 + 0.1 * 2.0 * left) as f32, (1.0 + 0.1 * 2.0 * right) as f32], "step {t}");
    }
    assert_normal(acted.iter().map(|acted| acted[0].into()).collect(), 0.25, 0.2);
    assert_normal(acted.iter().map(|acted| acted[1].into()).collect(), 1.0, 0.2);
}

#[test]
fn scales_weaken_all_motors_or_one() {
    let acting = |values: &[(&str, f64)]| acted(&mut echo(values), 1, |_| [0.5, 2.5])[0];
    assert_eq!(acting(&[("action_scale", 0.5)]), [0.25, 1.5], "towards the neutral action");
    assert_eq!(acting(&[("action_scale_left", 0.5)]), [0.25, 2.5]);
    assert_eq!(acting(&[("action_scale_right", 0.0)]), [0.5, NEUTRAL[1]]);
    assert_eq!(acting(&[("action_scale", 0.5), ("action_scale_left", 0.5)]), [0.125, 1.5], "their product");
}

#[test]
fn actions_pass_delay_hold_noise_and_scale_in_order() {
    let values = [("action_delay", 2.0), ("action_hold", 0.5), ("action_noise", 0.1), ("action_scale", 0.5)];
    let acted = acted(&mut echo(&values), 200, action);
    let mut held = NEUTRAL;
    for (t, acted) in (0..200).zip(acted) {
        if t == 0 || stream(DrawPurpose::ActionHold, t).unit() >= 0.5 {
            held = if t < 2 { NEUTRAL } else { action(t - 2) };
        }
        let normals: [f64; 2] = normals(DrawPurpose::ActionNoise, t);
        let expected: [f32; 2] = std::array::from_fn(|i| {
            let noisy = (f64::from(held[i]) + 0.1 * 2.0 * normals[i]) as f32;
            let neutral = f64::from(NEUTRAL[i]);
            (neutral + 0.5 * (f64::from(noisy) - neutral)) as f32
        });
        assert_eq!(acted, expected, "step {t}");
    }
}

/// Takes steps. Returns the first observation and the observation after each step; each contains the number of steps.
fn seen(episodes: &mut Episodes, steps: u32) -> Vec<Vec<f32>> {
    let first = observe(episodes);
    let mut terms = [0.0];
    let step = |t| {
        episodes.step(Action::Continuous(&action(t)), &mut terms);
        assert_eq!(terms[0], f64::from(action(t)[0]), "rewards are exact");
        observe(episodes)
    };
    std::iter::once(first).chain((0..steps).map(step)).collect()
}

#[test]
fn late_observations_are_seen_after_the_delay() {
    let seen = seen(&mut echo(&[("sensor_delay", 3.0)]), 20);
    let steps: Vec<f32> = seen.iter().map(|seen| seen[2]).collect();
    assert_eq!(steps[..4], [0.0; 4], "the first one is seen until the next arrives");
    assert_eq!(steps[3..], (0..18).map(|t| t as f32).collect::<Vec<_>>());
}

#[test]
fn noise_on_observations_is_normal_and_a_share_of_the_scale() {
    let seen = seen(&mut echo(&[("sensor_noise", 0.1)]), DRAWS);
    let exact = |t: u32| if t == 0 { [0.0, 0.0] } else { action(t - 1).map(f64::from) };
    let mut noise = [Vec::new(), Vec::new()];
    for (t, seen) in (0..=DRAWS).zip(&seen) {
        let [left, right, steps] = normals(DrawPurpose::SensorNoise, t);
        let expected = [exact(t)[0] + 0.1 * left, exact(t)[1] + 0.1 * 3.0 * right, f64::from(t) + 0.1 * steps];
        assert_eq!(seen[..3], expected.map(|x| x as f32), "step {t}");
        assert_eq!(seen[3], echo::CONSTANT, "step {t}");
        noise[0].push(0.1 * left);
        noise[1].push(0.1 * 3.0 * right);
    }
    let [left, right] = noise;
    assert_normal(left, 0.0, 0.1);
    assert_normal(right, 0.0, 0.3);
}

#[test]
fn lost_observations_read_zero() {
    const PROBABILITY: f64 = 0.2;
    let seen = seen(&mut echo(&[("sensor_dropout", PROBABILITY)]), DRAWS);
    let mut lost = [0; 3];
    // Before the first step, the observed actions are 0.
    for (t, seen) in (1..=DRAWS).zip(&seen[1..]) {
        let mut stream = stream(DrawPurpose::SensorDropout, t);
        for (entry, lost) in seen.iter().zip(&mut lost) {
            assert_eq!(*entry == 0.0, stream.unit() < PROBABILITY, "step {t}");
            *lost += usize::from(*entry == 0.0);
        }
        assert_eq!(seen[3], echo::CONSTANT, "step {t}");
    }
    lost.iter().for_each(|&lost| assert_frequency(lost, DRAWS as usize, PROBABILITY));
}

#[test]
fn observations_pass_delay_noise_and_dropout_in_order() {
    let values = [("sensor_delay", 2.0), ("sensor_noise", 0.1), ("sensor_dropout", 0.3)];
    for (t, seen) in (0..=300).zip(seen(&mut echo(&values), 300)) {
        let [_, _, steps] = normals(DrawPurpose::SensorNoise, t);
        let mut dropout = stream(DrawPurpose::SensorDropout, t);
        let (_, _, is_lost) = (dropout.unit(), dropout.unit(), dropout.unit() < 0.3);
        let expected = if is_lost { 0.0 } else { f64::from(t.saturating_sub(2)) + 0.1 * steps };
        assert_eq!(seen[2], expected as f32, "step {t}");
    }
}

#[test]
fn whole_numbers_are_drawn_as_likely() {
    let mut settings = super::settings(&echo::SPEC, Version::D, &[], ADDRESS);
    Arc::make_mut(&mut settings.distributions)[0] = "0..4".parse().unwrap();
    let spec = perturb::env::disturbance::disturbed(&echo::SPEC);
    let mut episodes = Episodes::new((spec.make)().unwrap(), settings);
    const EPISODES: usize = 20_000;
    let mut counts = [0; 5];
    for _ in 0..EPISODES {
        let receipt = episodes.receipt();
        assert_eq!(receipt.requested, receipt.applied);
        assert_eq!(receipt.requested[0].fract(), 0.0);
        counts[receipt.requested[0] as usize] += 1;
        episodes.begin(None);
    }
    counts.iter().for_each(|&count| assert_frequency(count, EPISODES, 0.2));
}

/// Takes steps. Returns the push of each step, along x and z.
fn pushed(episodes: &mut Episodes, steps: u32) -> Vec<[f64; 2]> {
    seen(episodes, steps)[1..].iter().map(|seen| [seen[4].into(), seen[5].into()]).collect()
}

#[test]
fn pushes_come_at_random_in_random_directions() {
    const SIZE: f64 = 3.0;
    const INTERVAL: f64 = 4.0;
    let pushed = pushed(&mut echo(&[("push", SIZE), ("push_interval", INTERVAL)]), DRAWS);
    let mut angles = Vec::new();
    for (t, push) in (0..DRAWS).zip(&pushed) {
        let mut stream = stream(DrawPurpose::Push, t);
        if stream.unit() < 1.0 / INTERVAL {
            let turn = stream.unit();
            let (sin, cos) = libm::sincos(std::f64::consts::TAU * turn);
            assert_eq!(push.map(|part| part as f32), [(SIZE * cos) as f32, (SIZE * sin) as f32], "step {t}");
            angles.push(turn);
        } else {
            assert_eq!(*push, [0.0; 2], "step {t}");
        }
    }
    assert_frequency(angles.len(), DRAWS as usize, 1.0 / INTERVAL);
    assert_uniform(angles);
    // After a push, the next step is as likely to have a push as any other step.
    let both = pushed.windows(2).filter(|pair| pair.iter().all(|push| *push != [0.0; 2])).count();
    assert_frequency(both, pushed.len() - 1, 1.0 / (INTERVAL * INTERVAL));
}

#[test]
fn pushes_of_no_size_are_none_and_the_shortest_interval_is_one() {
    assert!(pushed(&mut echo(&[("push_interval", 1.0)]), 100).iter().all(|push| *push == [0.0; 2]));
    let every = pushed(&mut echo(&[("push", 2.0), ("push_interval", 1.0)]), 100);
    assert!(every.iter().all(|[x, z]| (x.hypot(*z) - 2.0).abs() < 1e-6), "f32 rounds by 1e-7");
}

#[test]
fn directions_are_uniform_on_a_line_a_circle_and_a_sphere() {
    let directions = |n| {
        let direction = move |t| stream(DrawPurpose::Push, t).direction(n);
        (0..DRAWS).map(direction).inspect(|[x, y, z]| assert!((x * x + y * y + z * z - 1.0).abs() < 1e-12))
    };
    let right = directions(1).filter(|direction| *direction == [1.0, 0.0, 0.0]).count();
    assert!(directions(1).all(|[x, y, z]| x.abs() == 1.0 && (y, z) == (0.0, 0.0)));
    assert_frequency(right, DRAWS as usize, 0.5);
    let turn = |x: f64, y: f64| y.atan2(x) / std::f64::consts::TAU + 0.5;
    assert!(directions(2).all(|direction| direction[2] == 0.0));
    assert_uniform(directions(2).map(|[x, y, _]| turn(x, y)).collect());
    // For points on a sphere, each coordinate is uniform (Archimedes).
    assert_uniform(directions(3).map(|[x, y, _]| turn(x, y)).collect());
    for axis in 0..3 {
        assert_uniform(directions(3).map(|direction| (direction[axis] + 1.0) / 2.0).collect());
    }
}
