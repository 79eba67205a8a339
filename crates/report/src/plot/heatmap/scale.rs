//! Colour scales for mean returns.

use std::ops::Range;

use perturb_records::Heatmap;

use crate::plot::ticks::rounded;

/// The fixed colour scales of the paper's environments: (name, lowest return, highest return). Fixed scales make
/// pictures from different experiments comparable. A scale ends at the return of a very good policy; all higher returns
/// have the last colour.
const FIXED: [(&str, f64, f64); 6] = [
    // The reward is 1 for each of at most 200 steps.
    ("CartPole", 0.0, 200.0),
    // The reward is -1 for each of at most 200 steps. An episode of up to 110 steps is a success, and the best policies
    // take some 100.
    ("MountainCar", -200.0, -100.0),
    // The reward is -1 for each of at most 500 steps. An episode of up to 80 steps is a success.
    ("Acrobot", -500.0, -80.0),
    // A pendulum that hangs or spins gets a return of some -1600 in 200 steps. A pendulum that is swung up and held
    // gets -100 to -300, depending on its initial state.
    ("Pendulum", -1600.0, -200.0),
    // The reward is 1 for each of 1000 steps alive, plus 1212 for the 20 m of a success, minus the cost of the motors.
    ("HalfCheetah", 0.0, 2000.0),
    ("Hopper", 0.0, 2000.0),
];

/// Returns the common colour scale for the mean returns of `heatmaps`. The paper's environments have fixed scales. In
/// other environments, the scale is the range of all returns, rounded outwards.
pub fn common_returns<'a>(environment: &str, heatmaps: impl Iterator<Item = &'a Heatmap>) -> Range<f64> {
    if let Some((_, low, high)) = FIXED.into_iter().find(|(name, ..)| *name == environment) {
        return low..high;
    }
    let returns = heatmaps.flat_map(|heatmap| heatmap.points.iter().map(|point| point.mean_return));
    let (low, high) = returns.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
    if low > high {
        0.0..1.0
    } else if low < high {
        rounded(&(low..high))
    } else {
        high - 1.0..high
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture;
    use perturb_records::paper::ENVIRONMENTS;

    #[test]
    fn the_papers_environments_have_a_scale_whatever_is_shown() {
        for environment in ENVIRONMENTS {
            let of =
                |value: f64| common_returns(environment, std::iter::once(&fixture::heatmap(2, |_, _| (value, 0.0))));
            assert_eq!(of(-1e6), of(1e6), "{environment}");
            assert!(of(0.0).start < of(0.0).end);
        }
        assert_eq!(common_returns("CartPole", std::iter::empty()), 0.0..200.0);
    }

    #[test]
    fn scale_of_unknown_environment_is_rounded_outwards() {
        let [a, b] = [-5.0, 3.0].map(|value| fixture::heatmap(2, |mass, _| (value + mass, 0.0)));
        assert_eq!(common_returns("Ball", [&a, &b].into_iter()), -6.0..6.0);
        assert_eq!(common_returns("Ball", std::iter::once(&fixture::heatmap(2, |_, _| (7.0, 0.0)))), 6.0..7.0);
        assert_eq!(common_returns("Ball", std::iter::empty()), 0.0..1.0);
    }
}
