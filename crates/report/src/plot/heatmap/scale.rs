//! Ranges of the colours of mean returns.

use std::ops::Range;

use perturb_records::Heatmap;

use crate::plot::ticks::rounded;

/// The fixed scales of the paper's environments: (name, low, high). They make pictures from different experiments
/// comparable. A scale ends where little is left to gain; all higher returns have its last colour.
const FIXED: [(&str, f64, f64); 6] = [
    // 1 for each of at most 200 steps.
    ("CartPole", 0.0, 200.0),
    // -1 for each of at most 200 steps; 110 are a success, and the best policies take some 100.
    ("MountainCar", -200.0, -100.0),
    // -1 for each of at most 500 steps; 80 are a success.
    ("Acrobot", -500.0, -80.0),
    // A rod that hangs or spins has some -1600 after 200 steps; one that is swung up and held -100 to -300, by where it began.
    ("Pendulum", -1600.0, -200.0),
    // 1 for each of 1000 steps alive, and for the 20 m of a success 1212, less the cost of the motors.
    ("HalfCheetah", 0.0, 2000.0),
    ("Hopper", 0.0, 2000.0),
];

/// Returns the colour scale for the mean returns of `heatmaps` in `environment`. The paper's environments have a fixed
/// scale. Other scales reach from the lowest to the highest return, rounded outwards.
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
