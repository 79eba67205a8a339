//! The rules of the heuristic policies, as weights of feed-forward networks.
//!
//! x is the observation. All rules but Pendulum's follow from the sign of a number s(x), a linear function of x:
//!
//! - CartPole: s = 4 θ + θ̇, where θ is the pole's angle. The policy pushes to the side of the sign.
//! - MountainCar: s = v - 0.001 (p + π/6), where p is the position, v the velocity, and -π/6 the bottom of the valley.
//!   The policy pushes in the direction of the velocity. At rest, s makes it push downhill.
//! - Acrobot: s = θ̇₂ - 2 θ̇₁. The torque has the sign of s.
//! - Pendulum: if cos θ < -0.1, the torque is 2 N m in the direction of θ̇, so the rod gains energy. Otherwise the torque
//!   is about -20 sin θ - 5 θ̇, up to ±2 N m, which brings the rod to the top and holds it there.
//!
//! The numbers were chosen on episodes of D, R and E with other random numbers than the tests have.

use std::f32::consts::FRAC_PI_6;

use perturb_policy::{ActionKind, NamedArray, PolicySpec, Weights};

use super::{Result, TrainError};
use crate::proto::Environment;

/// A unit of a network: its first weights, and its bias. All other weights are 0.
type Unit<'a> = (&'a [f32], f32);

/// Factor that saturates tanh: the output is ±1 unless the input is almost 0.
const SATURATION: f32 = 1e5;

/// The highest logit of an action. That of each other action is lower by `MAX_LOGIT` or more, so the probability of the
/// other actions is at most e^-100, about 4e-44. `MAX_LOGIT` also saturates the units of Pendulum's second layer.
const MAX_LOGIT: f32 = 100.0;

/// Logarithm of the standard deviation of Pendulum's torque. The deviation is about 2e-9 N m.
const LOG_STD: f32 = -20.0;

/// Returns the weights of the heuristic policy. Returns an error if `environment` has none.
pub(super) fn weights(policy: &PolicySpec, environment: &Environment) -> Result<Weights> {
    let layers: [&[Unit<'_>]; 3] = match environment.name.as_str() {
        "CartPole" => {
            [&[(&[0.0, 0.0, 4.0 * SATURATION, SATURATION], 0.0)], SIGN, &[(&[-MAX_LOGIT], 0.0), (&[MAX_LOGIT], 0.0)]]
        }
        "MountainCar" => {
            [&[(&[-0.001 * SATURATION, SATURATION], -0.001 * FRAC_PI_6 * SATURATION)], SIGN, THREE_CHOICES]
        }
        "Acrobot" => [&[(&[0.0, 0.0, 0.0, 0.0, -2.0 * SATURATION, SATURATION], 0.0)], SIGN, THREE_CHOICES],
        "Pendulum" => PENDULUM,
        name => return Err(TrainError::NoHeuristic { environment: name.into() }),
    };
    // A server may have another environment of this name.
    let (ActionKind::Discrete { n: outputs } | ActionKind::Continuous { size: outputs }) = policy.action;
    if outputs != layers[2].len() || layers[0].iter().any(|(weights, _)| weights.len() > policy.observation_size) {
        return Err(TrainError::NoHeuristic { environment: environment.name.clone() });
    }
    let array = |(name, shape): (String, Vec<usize>)| {
        let mut data = vec![0.0; shape.iter().product()];
        if name == "log_std" {
            data.fill(LOG_STD);
        }
        for (i, layer) in layers.iter().enumerate() {
            for (row, (weights, bias)) in layer.iter().enumerate() {
                if name == format!("policy.{i}.weight") {
                    data[row * shape[1]..][..weights.len()].copy_from_slice(weights);
                } else if name == format!("policy.{i}.bias") {
                    data[row] = *bias;
                }
            }
        }
        NamedArray { name, shape, data }
    };
    Ok(policy.layout().into_iter().map(array).collect())
}

/// The second layer of a rule that follows from a sign: passes on ±1, the output of the first layer's first unit.
const SIGN: &[Unit<'_>] = &[(&[SATURATION], 0.0)];

/// The output of a rule that chooses the first action for -1, and the third action for 1.
const THREE_CHOICES: &[Unit<'_>] = &[(&[-MAX_LOGIT], 0.0), (&[0.0], 0.0), (&[MAX_LOGIT], 0.0)];

/// The network of Pendulum's rule, whose inputs are cos θ, sin θ and θ̇.
///
/// The units of the first layer are `above` (1 if cos θ > -0.1, otherwise -1), `gain` (the sign of θ̇) and `hold` (a
/// tenth of the torque near the top). In the second layer, the first two units are both half of the torque if `above`
/// is 1, and add up to 0 otherwise. The last two units are both `gain` if `above` is -1, and add up to 0 otherwise. The
/// torque is the sum of these four units.
const PENDULUM: [&[Unit<'_>]; 3] = [
    &[(&[SATURATION], 0.1 * SATURATION), (&[0.0, 0.0, SATURATION], 0.0), (&[0.0, -2.0, -0.5], 0.0)],
    &[
        (&[MAX_LOGIT, 0.0, 5.0], -MAX_LOGIT),
        (&[-MAX_LOGIT, 0.0, 5.0], MAX_LOGIT),
        (&[MAX_LOGIT, MAX_LOGIT / 2.0, 0.0], MAX_LOGIT),
        (&[-MAX_LOGIT, MAX_LOGIT / 2.0, 0.0], -MAX_LOGIT),
    ],
    &[(&[1.0, 1.0, 1.0, 1.0], 0.0)],
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proto::{ActionSpace, Channel, Continuous, Discrete, action_space::Kind};
    use crate::training::untrained::checkpoint;

    /// Returns the first actions of the heuristic policy for `observations`, or the error.
    fn actions<const O: usize>(name: &str, kind: Kind, observations: &[[f32; O]]) -> Result<Vec<[u8; 4]>> {
        let observation = vec![Channel::default(); O];
        let action = Some(ActionSpace { kind: Some(kind) });
        let environment = Environment { name: name.into(), observation, action, ..Environment::default() };
        let table = format!("environment = '{name}'\nalgorithm = 'heuristic'").parse().unwrap();
        let checkpoint = checkpoint(&perturb_settings::TrainConfig::from_table("", table).unwrap(), &environment)?;
        let mut player = checkpoint.player(observations.len(), 7, 0).unwrap();
        player.begin(observations.as_flattened(), None).unwrap();
        Ok(player.act().unwrap().as_chunks::<4>().0.to_vec())
    }

    fn choices<const O: usize>(name: &str, n: usize, observations: &[[f32; O]]) -> Vec<i32> {
        let kind = Kind::Discrete(Discrete { names: vec![String::new(); n] });
        actions(name, kind, observations).unwrap().into_iter().map(i32::from_le_bytes).collect()
    }

    #[test]
    fn cart_is_pushed_to_the_side_to_which_the_pole_falls() {
        let observations = [[2.0, 1.0, 0.1, -0.39], [2.0, 1.0, 0.1, -0.41], [-2.0, -1.0, -0.1, 0.41]];
        assert_eq!(choices("CartPole", 2, &observations), [1, 0, 1]);
    }

    #[test]
    fn car_is_pushed_in_its_direction_and_at_rest_downhill() {
        let observations = [[0.3, 0.001], [-1.1, -0.001], [-0.5, 0.0], [-0.55, 0.0]];
        assert_eq!(choices("MountainCar", 3, &observations), [2, 0, 0, 2]);
    }

    #[test]
    fn acrobot_turns_by_the_velocities_of_its_links() {
        let observations = [[1.0, 0.0, 1.0, 0.0, 0.1, 0.21], [-1.0, 0.0, 1.0, 0.0, 0.1, 0.19]];
        assert_eq!(choices("Acrobot", 3, &observations), [2, 0]);
    }

    #[test]
    fn pendulum_gains_energy_below_and_is_held_above() {
        let kind =
            Kind::Continuous(Continuous { channels: vec![Channel { low: -2.0, high: 2.0, ..Channel::default() }] });
        let below = [[-0.2, 0.9798, 0.01], [-0.2, 0.9798, -0.01]];
        let above = [[0.0, 1.0, -3.9], [0.0, 1.0, -4.1], [1.0, 0.01, 0.01], [1.0, 0.0, 0.0]];
        let torques = actions("Pendulum", kind, &[below.as_slice(), &above].concat()).unwrap();
        // The last torques are those of the law -20 sin θ - 5 θ̇, saturated by 2 tanh(5 tanh(·/10)).
        for (torque, expected) in torques.into_iter().map(f32::from_le_bytes).zip([2.0, -2.0, -0.49, 0.49, -0.245, 0.0])
        {
            assert!((torque - expected).abs() < 0.02, "{torque} instead of {expected}");
        }
    }

    #[test]
    fn other_environments_have_no_heuristic_policy() {
        // The second environment has only the name of a known one.
        for name in ["Hopper", "Acrobot"] {
            let kind = Kind::Discrete(Discrete { names: vec![String::new(); 2] });
            let error = actions(name, kind, &[[0.0; 6]]).unwrap_err().to_string();
            let expected = "; CartPole, MountainCar, Acrobot and Pendulum have one";
            assert_eq!(error, format!("there is no heuristic policy for {name}{expected}"));
        }
    }
}
