//! Parameters are drawn as the paper says: D is exact, R is uniform, and E is uniform over the two intervals around R.
//! Other values are refused.

use crate::common;
use perturb::{
    env::{
        self, Distribution, DrawPurpose, EnvironmentSpec, Error, Interval, ParameterSpec, PhiloxStream, Version,
        check_bounds, resolve,
    },
    tasks,
};
use proptest::prelude::*;
use rstest::rstest;
use std::sync::Arc;

/// The table of docs/environments.md and of the paper: environment, parameter, unit, D, R, E.
#[rustfmt::skip]
#[allow(clippy::type_complexity)]
const DOCUMENT: &[(&str, &str, &str, f64, (f64, f64), [(f64, f64); 2])] = &[
    ("CartPole", "force", "N", 10.0, (5.0, 15.0), [(1.0, 5.0), (15.0, 20.0)]),
    ("CartPole", "length", "m", 0.5, (0.25, 0.75), [(0.05, 0.25), (0.75, 1.0)]),
    ("CartPole", "mass", "kg", 0.1, (0.05, 0.5), [(0.01, 0.05), (0.5, 1.0)]),
    ("MountainCar", "force", "1", 0.001, (0.0005, 0.005), [(0.0001, 0.0005), (0.005, 0.01)]),
    ("MountainCar", "mass", "1", 0.0025, (0.001, 0.005), [(0.0005, 0.001), (0.005, 0.01)]),
    ("Acrobot", "length", "m", 1.0, (0.75, 1.25), [(0.5, 0.75), (1.25, 1.5)]),
    ("Acrobot", "mass", "kg", 1.0, (0.75, 1.25), [(0.5, 0.75), (1.25, 1.5)]),
    ("Acrobot", "moi", "kg m²", 1.0, (0.75, 1.25), [(0.5, 0.75), (1.25, 1.5)]),
    ("Pendulum", "length", "m", 1.0, (0.75, 1.25), [(0.5, 0.75), (1.25, 1.5)]),
    ("Pendulum", "mass", "kg", 1.0, (0.75, 1.25), [(0.5, 0.75), (1.25, 1.5)]),
    ("HalfCheetah", "power", "1", 0.9, (0.7, 1.1), [(0.5, 0.7), (1.1, 1.3)]),
    ("HalfCheetah", "density", "kg/m³", 1000.0, (750.0, 1250.0), [(500.0, 750.0), (1250.0, 1500.0)]),
    ("HalfCheetah", "friction", "1", 0.8, (0.5, 1.1), [(0.2, 0.5), (1.1, 1.4)]),
    ("Hopper", "power", "1", 0.75, (0.6, 0.9), [(0.4, 0.6), (0.9, 1.1)]),
    ("Hopper", "density", "kg/m³", 1000.0, (750.0, 1250.0), [(500.0, 750.0), (1250.0, 1500.0)]),
    ("Hopper", "friction", "1", 0.8, (0.5, 1.1), [(0.2, 0.5), (1.1, 1.4)]),
];

/// The number of trials that are drawn for each test of a distribution.
const DRAWS: u32 = 4000;
/// The number of standard deviations beyond which a count fails the test. By chance a count fails once in 1.7 million
/// comparisons, and the seed is fixed.
const SIGMAS: f64 = 5.0;
/// The bound of √n times the Kolmogorov-Smirnov distance. By chance it is exceeded with probability 2 exp(-2 · 2.7²) =
/// 9e-7.
const KOLMOGOROV_SMIRNOV: f64 = 2.7;

fn all_parameters() -> Vec<(&'static str, &'static ParameterSpec)> {
    let catalogue = tasks::catalogue();
    catalogue.specs().flat_map(|spec| spec.parameters.iter().map(|parameter| (spec.name, parameter))).collect()
}

/// Returns the parameters of `DRAWS` trials, `[DRAWS, P]`, from the receipts of the episodes.
fn drawn(spec: &'static EnvironmentSpec, version: Version) -> Vec<Vec<f64>> {
    let mut episodes = common::episodes(spec, version, 2026, 3, 1);
    let draw = |_| {
        episodes.begin(None);
        episodes.receipt().requested
    };
    (0..DRAWS).map(draw).collect()
}

fn column(rows: &[Vec<f64>], parameter: usize) -> Vec<f64> {
    rows.iter().map(|row| row[parameter]).collect()
}

/// Returns √n times the largest distance between the empirical distribution of the values and the uniform one on
/// `interval`.
fn distance_from_uniform(mut values: Vec<f64>, interval: Interval) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len() as f64;
    let distance = values.iter().enumerate().map(|(i, value)| {
        let expected = (value - interval.low) / (interval.high - interval.low);
        (expected - i as f64 / n).abs().max((expected - (i + 1) as f64 / n).abs())
    });
    n.sqrt() * distance.fold(0.0, f64::max)
}

#[test]
fn the_table_is_the_document() {
    let interval = |i: Interval| (i.low, i.high);
    let table: Vec<_> = all_parameters()
        .into_iter()
        .map(|(name, p)| (name, p.name, p.unit, p.default, interval(p.random), p.extreme.map(interval)))
        .collect();
    let catalogue = tasks::catalogue();
    let document: Vec<_> = DOCUMENT.iter().copied().filter(|row| catalogue.find(row.0).is_ok()).collect();
    assert_eq!(table, document);
}

#[test]
fn defaults_lie_in_r_and_r_lies_between_the_halves_of_e() {
    for (name, p) in all_parameters() {
        let place = format!("{name}, {}", p.name);
        assert!(p.random.low <= p.default && p.default <= p.random.high, "{place}");
        assert!(p.bounds.low <= p.extreme[0].low && p.extreme[1].high <= p.bounds.high, "{place}");
        assert_eq!((p.extreme[0].high, p.extreme[1].low), (p.random.low, p.random.high), "{place}");
        assert!(p.extreme[0].low < p.extreme[0].high && p.extreme[1].low < p.extreme[1].high, "{place}");
        // `distribution` panics if a union is invalid.
        for version in [Version::D, Version::R, Version::E] {
            p.distribution(version);
        }
    }
}

#[test]
fn d_is_always_the_default() {
    for spec in tasks::catalogue().specs() {
        let defaults: Vec<f64> = spec.parameters.iter().map(|p| p.default).collect();
        let mut episodes = common::episodes(spec, Version::D, 1, 0, 1);
        for _ in 0..20 {
            assert_eq!(episodes.receipt().requested, defaults, "{}", spec.name);
            episodes.begin(None);
        }
    }
}

#[test]
fn r_is_uniform_on_its_interval() {
    for spec in tasks::catalogue().specs() {
        let rows = drawn(spec, Version::R);
        for (i, p) in spec.parameters.iter().enumerate() {
            let values = column(&rows, i);
            assert!(values.iter().all(|v| (p.random.low..=p.random.high).contains(v)), "{} {}", spec.name, p.name);
            let distance = distance_from_uniform(values, p.random);
            assert!(distance < KOLMOGOROV_SMIRNOV, "{} {}: {distance}", spec.name, p.name);
        }
    }
}

#[test]
fn e_draws_intervals_by_length_and_nothing_inside_r() {
    for spec in tasks::catalogue().specs() {
        let rows = drawn(spec, Version::E);
        for (i, p) in spec.parameters.iter().enumerate() {
            let place = format!("{} {}", spec.name, p.name);
            let [lower, upper] = p.extreme;
            let (below, above): (Vec<f64>, Vec<f64>) = column(&rows, i).into_iter().partition(|v| *v <= p.random.low);
            assert!(below.iter().all(|v| *v >= lower.low), "{place}");
            assert!(above.iter().all(|v| (upper.low..=upper.high).contains(v)), "{place}");

            let share = (lower.high - lower.low) / (lower.high - lower.low + upper.high - upper.low);
            let n = f64::from(DRAWS);
            let sigmas = (below.len() as f64 - n * share) / (n * share * (1.0 - share)).sqrt();
            assert!(sigmas.abs() < SIGMAS, "{place}: {} of {n} in {lower}, {sigmas} σ", below.len());

            for (values, interval) in [(below, lower), (above, upper)] {
                let distance = distance_from_uniform(values, interval);
                assert!(distance < KOLMOGOROV_SMIRNOV, "{place} in {interval}: {distance}");
            }
        }
    }
}

#[test]
fn parameters_are_drawn_independently() {
    for spec in tasks::catalogue().specs() {
        let rows = drawn(spec, Version::R);
        let scaled = |i: usize| {
            let interval = spec.parameters[i].random;
            column(&rows, i).into_iter().map(move |v| (v - interval.low) / (interval.high - interval.low) - 0.5)
        };
        for i in 0..spec.parameters.len() {
            for j in 0..i {
                // If the two parameters are independent, the mean of the product has standard deviation 1 / (12 √n).
                let mean = scaled(i).zip(scaled(j)).map(|(a, b)| a * b).sum::<f64>() / f64::from(DRAWS);
                let sigmas = mean * 12.0 * f64::from(DRAWS).sqrt();
                assert!(sigmas.abs() < SIGMAS, "{}: parameters {i} and {j}: {sigmas} σ", spec.name);
            }
        }
    }
}

#[test]
fn a_union_of_three_draws_each_in_proportion() {
    let intervals = [Interval::new(-1.0, 0.0), Interval::new(2.0, 5.0), Interval::new(5.0, 11.0)];
    let distribution = Distribution::union(&intervals).unwrap();
    let mut stream = PhiloxStream::new(7, 0, DrawPurpose::Parameters, 0);
    let n = 20_000;
    let values: Vec<f64> = (0..n).map(|_| distribution.at(stream.unit())).collect();
    for (interval, share) in intervals.into_iter().zip([0.1, 0.3, 0.6]) {
        let count = values.iter().filter(|v| interval.low <= **v && **v < interval.high).count();
        let sigmas = (count as f64 - f64::from(n) * share) / (f64::from(n) * share * (1.0 - share)).sqrt();
        assert!(sigmas.abs() < SIGMAS, "{count} in {interval}: {sigmas} σ");
    }
}

#[test]
fn overrides_replace_only_what_they_name() {
    let spec = tasks::catalogue().find("CartPole").unwrap();
    let mut distributions: Vec<_> = spec.distributions(Version::R);
    let union = Distribution::union(&[Interval::new(0.2, 0.3), Interval::new(2.0, 2.1)]).unwrap();
    let overrides = [("mass", union.clone()), ("force", Distribution::fixed(7.0))];
    resolve(spec, &mut distributions, overrides).unwrap();
    assert_eq!(distributions, [Distribution::fixed(7.0), spec.parameters[1].distribution(Version::R), union]);

    let settings =
        env::EpisodeSettings { distributions: distributions.into(), ..common::settings(spec, Version::R, 5, 0, 1) };
    let mut episodes = env::Episodes::new((spec.make)().unwrap(), settings);
    let mut lengths = Vec::new();
    for _ in 0..50 {
        let [force, length, mass] = episodes.receipt().requested[..] else { panic!("three parameters") };
        assert_eq!(force, 7.0);
        assert!((0.2..=0.3).contains(&mass) || (2.0..=2.1).contains(&mass), "{mass}");
        lengths.push(length);
        episodes.begin(None);
    }
    lengths.sort_by(f64::total_cmp);
    lengths.dedup();
    assert_eq!(lengths.len(), 50, "the parameter that was not overridden is still drawn");
}

#[test]
fn an_override_does_not_move_the_other_parameters_draws() {
    let spec = tasks::catalogue().find("CartPole").unwrap();
    let base = common::settings(spec, Version::E, 9, 2, 1);
    let mut changed = base.clone();
    resolve(spec, Arc::make_mut(&mut changed.distributions), [("force", Distribution::fixed(7.0))]).unwrap();
    let receipt = |settings| env::Episodes::new((spec.make)().unwrap(), settings).receipt().requested;
    assert_eq!(receipt(base)[1..], receipt(changed)[1..]);
}

#[test]
fn trial_of_r_and_e_is_all_of_one_of_them() {
    for spec in tasks::catalogue().specs() {
        let mut of_r = 0;
        for (trial, got) in (1..).zip(drawn(spec, Version::RE)) {
            let mut stream = PhiloxStream::new(2026, 3, DrawPurpose::Parameters, trial);
            let part = if stream.unit() < 0.5 { Version::R } else { Version::E };
            let expected: Vec<f64> = spec.parameters.iter().map(|p| p.distribution(part).at(stream.unit())).collect();
            assert_eq!(got, expected, "{} trial {trial}, {part}", spec.name);
            of_r += u32::from(part == Version::R);
        }
        let sigmas = (f64::from(of_r) - f64::from(DRAWS) / 2.0) / (f64::from(DRAWS) / 4.0).sqrt();
        assert!(sigmas.abs() < SIGMAS, "{}: {of_r} trials of R: {sigmas} σ", spec.name);
    }
}

#[test]
fn overrides_replace_the_sets_of_r_and_of_e() {
    let spec = tasks::catalogue().find("CartPole").unwrap();
    let mut distributions = spec.distributions(Version::RE);
    resolve(spec, &mut distributions, [("length", Distribution::fixed(0.7))]).unwrap();
    let expected = [Version::R, Version::E].map(|part| {
        let [force, _, mass] = [0, 1, 2].map(|place: usize| spec.parameters[place].distribution(part));
        [force, Distribution::fixed(0.7), mass]
    });
    assert_eq!(distributions, expected.concat());
}

#[rstest]
#[case::empty(&[], "1 to 64 intervals")]
#[case::nan_low(&[(f64::NAN, 1.0)], "finite ends")]
#[case::nan_high(&[(0.0, f64::NAN)], "finite ends")]
#[case::infinite_low(&[(-f64::INFINITY, 1.0)], "finite ends")]
#[case::infinite_high(&[(0.0, f64::INFINITY)], "finite ends")]
#[case::the_second_infinite(&[(0.0, 1.0), (2.0, f64::INFINITY)], "finite ends")]
#[case::reversed(&[(2.0, 1.0)], "low at most high in every interval")]
#[case::the_second_reversed(&[(0.0, 1.0), (3.0, 2.0)], "low at most high in every interval")]
#[case::a_point_first(&[(0.0, 0.0), (1.0, 2.0)], "intervals of positive length; a fixed value stands alone")]
#[case::a_point_second(&[(0.0, 1.0), (1.0, 1.0)], "intervals of positive length; a fixed value stands alone")]
#[case::overlapping(&[(0.0, 2.0), (1.0, 3.0)], "ascending intervals that do not overlap")]
#[case::descending(&[(2.0, 3.0), (0.0, 1.0)], "ascending intervals that do not overlap")]
#[case::twice(&[(0.0, 1.0), (0.0, 1.0)], "ascending intervals that do not overlap")]
fn a_union_that_is_none_is_refused(#[case] pairs: &[(f64, f64)], #[case] reason: &str) {
    let intervals: Vec<_> = pairs.iter().map(|&(low, high)| Interval::new(low, high)).collect();
    assert_eq!(Distribution::union(&intervals).unwrap_err().expected, reason);
}

#[test]
fn distribution_has_at_most_64_intervals() {
    let intervals = |n: u32| (0..n).map(|i| Interval::new(i.into(), f64::from(i) + 0.5)).collect::<Vec<_>>();
    assert!(Distribution::union(&intervals(64)).is_ok());
    let long = "m".repeat(1_000_000);
    let refusals = [
        Distribution::union(&intervals(65)).unwrap_err().to_string(),
        Distribution::union(&intervals(100_000)).unwrap_err().to_string(),
        tasks::catalogue().find(&long).unwrap_err().to_string(),
        resolve(tasks::catalogue().find("Pendulum").unwrap(), &mut [], [(long.as_str(), Distribution::fixed(1.0))])
            .unwrap_err()
            .to_string(),
    ];
    for refusal in refusals {
        assert!(refusal.len() < 600, "{} bytes", refusal.len());
    }
}

#[test]
fn intervals_may_touch_and_a_single_one_may_be_a_point() {
    assert!(Distribution::union(&[Interval::new(0.0, 1.0), Interval::new(1.0, 2.0)]).is_ok());
    assert_eq!(Distribution::union(&[Interval::new(3.0, 3.0)]).unwrap(), Distribution::fixed(3.0));
}

#[test]
fn overrides_that_are_wrong_change_nothing() {
    for spec in tasks::catalogue().specs() {
        let base: Vec<_> = spec.distributions(Version::R);
        for parameter in spec.parameters {
            let Interval { low, high } = parameter.bounds;
            let beyond = [Interval::new(low.next_down(), high), Interval::new(low, high.next_up())];
            for interval in beyond {
                let mut distributions = base.clone();
                // A valid distribution comes before the invalid one.
                let right = (spec.parameters[0].name, Distribution::fixed(spec.parameters[0].default));
                let wrong = (parameter.name, Distribution::union(&[interval]).unwrap());
                let refused = resolve(spec, &mut distributions, [right, wrong]).unwrap_err();
                assert!(matches!(refused, Error::OutOfRange { .. }), "{refused}");
                assert!(refused.to_string().contains(parameter.name), "{refused}");
                assert_eq!(distributions, base);
            }
            let mut distributions = base.clone();
            let whole = Distribution::union(&[parameter.bounds]).unwrap();
            resolve(spec, &mut distributions, [(parameter.name, whole)]).unwrap();
            assert!(check_bounds(spec, parameter, (f64::NAN, high)).is_err(), "NaN is in no range");
            assert!(check_bounds(spec, parameter, (low, f64::NAN)).is_err(), "NaN is in no range");
        }
        let mut distributions = base.clone();
        let right = (spec.parameters[0].name, Distribution::fixed(spec.parameters[0].default));
        let refused = resolve(spec, &mut distributions, [right, ("colour", Distribution::fixed(1.0))]).unwrap_err();
        assert!(matches!(refused, Error::UnknownParameter { .. }), "{refused}");
        assert_eq!(distributions, base);
    }
}

/// Generates one to five ascending intervals, some touching, of very different lengths.
fn unions() -> impl Strategy<Value = Vec<Interval>> {
    let part = (prop_oneof![Just(0.0), 1e-9..1e-3, 0.0..1e5], prop_oneof![1e-12..1e-6, 0.001..1.0, 1.0..1e5]);
    (-1e5..1e5, prop::collection::vec(part, 1..6)).prop_map(|(mut at, parts)| {
        let interval = |(gap, length): (f64, f64)| {
            let low: f64 = at + gap;
            let high = (low + length).max(low.next_up());
            at = high;
            Interval::new(low, high)
        };
        parts.into_iter().map(interval).collect()
    })
}

/// Generates fractions, including the smallest and the largest: the streams give multiples of 2⁻⁵³ below 1.
fn fractions() -> impl Strategy<Value = f64> {
    prop_oneof![8 => 0.0..1.0, 1 => Just(0.0), 1 => Just(1.0_f64.next_down())]
}

proptest! {
    #[test]
    fn a_draw_lies_in_the_union_and_grows_with_the_fraction(
        intervals in unions(), u in fractions(), v in fractions()
    ) {
        let distribution = Distribution::union(&intervals).unwrap();
        let (u, v) = (u.min(v), u.max(v));
        let (at_u, at_v) = (distribution.at(u), distribution.at(v));
        for value in [at_u, at_v] {
            prop_assert!(intervals.iter().any(|i| (i.low..=i.high).contains(&value)), "{value} in {intervals:?}");
        }
        prop_assert!(at_u <= at_v, "at({u}) = {at_u}, at({v}) = {at_v}");
        prop_assert_eq!(distribution.at(0.0), intervals[0].low);
        prop_assert_eq!(distribution.range(), (intervals[0].low, intervals[intervals.len() - 1].high));
    }

    #[test]
    fn a_fixed_value_is_exact(value in -1e300..1e300, u in fractions()) {
        prop_assert_eq!(Distribution::fixed(value).at(u), value);
    }

    #[test]
    fn whatever_is_accepted_can_be_drawn_from(
        pairs in prop::collection::vec((any::<f64>(), any::<f64>()), 0..4), u in fractions()
    ) {
        let intervals: Vec<_> = pairs.iter().map(|&(low, high)| Interval::new(low, high)).collect();
        if let Ok(distribution) = Distribution::union(&intervals) {
            let value = distribution.at(u);
            prop_assert!(intervals.iter().any(|i| (i.low..=i.high).contains(&value)), "{value} in {intervals:?}");
        }
    }
}
