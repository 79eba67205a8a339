//! The random initial state of an episode: the model's initial state or a keyframe, with noise, and joints that are
//! placed by rules.
//!
//! Random numbers are drawn in this order: noise on positions, in the model's order; noise on velocities, in the
//! model's order; then for each table in `joints` its positions and its velocities.

use super::{
    elements::Elements,
    error::Result,
    table::{TomlTable, Value},
};
use crate::env::PhiloxStream;
use perturb_mujoco::{ElementKind, Index, Model, ModelField};
use std::f64::consts::TAU;

const RESET: &[&str] = &["keyframe", "position", "velocity", "joints"];
const NOISE: &[&str] = &["uniform", "normal"];
const JOINTS: &[&str] = &["joint", "position", "velocity"];
const PLACEMENT: &[&str] = &["uniform", "normal", "disc", "box", "beyond"];
/// Maximal number of attempts to draw a point in a box that is far enough from 0. After the last attempt, its point is
/// used anyway.
const MAX_DRAWS: usize = 1000;

/// Noise that is added to a number.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Noise {
    /// Uniform between minus this number and this number.
    Uniform(f64),
    /// Normally distributed with mean 0 and this standard deviation.
    Normal(f64),
}

/// The rule by which the positions or velocities of some joints are drawn.
#[derive(Debug, Clone, PartialEq)]
enum Placement {
    /// Each number is its initial value plus noise.
    Noise(Noise),
    /// Each number has this value.
    Fixed(f64),
    /// Each number is uniform in this interval.
    Interval(f64, f64),
    /// Two numbers, the coordinates of a point that is uniform in a disc about 0 with this radius.
    Disc(f64),
    /// The numbers are the coordinates of a point that is uniform in the box of these intervals, farther from 0 than
    /// the given distance.
    Box(Vec<(f64, f64)>, f64),
}

/// The distribution of initial states.
#[derive(Debug, Clone)]
pub(super) struct InitialStateDistribution {
    /// The positions, then the velocities, without noise.
    base: Vec<f64>,
    /// The indices in `base` of the numbers with noise, and their noise.
    noise: Vec<(usize, Noise)>,
    /// The indices in `base` of numbers that are drawn together, and their rule.
    placed: Vec<(Vec<usize>, Placement)>,
}

impl InitialStateDistribution {
    /// Reads the distribution from the TOML table `reset`. Without a table, the state is the model's initial state.
    pub(super) fn new(table: Option<&TomlTable<'_>>, model: &Model, elements: &Elements) -> Result<Self> {
        let (n_q, n_v) = (model.n_q(), model.n_v());
        let mut base = [model.field(ModelField::InitialPositions), &vec![0.0; n_v]].concat();
        let Some(table) = table else { return Ok(Self { base, noise: Vec::new(), placed: Vec::new() }) };
        table.only(RESET)?;
        if let Some(value) = table.get("keyframe") {
            let key = elements.find(ElementKind::Keyframe, &value)?;
            base[..n_q].copy_from_slice(&model.field(ModelField::KeyPositions)[key * n_q..][..n_q]);
            base[n_q..].copy_from_slice(&model.field(ModelField::KeyVelocities)[key * n_v..][..n_v]);
        }
        // Joints that are placed by rules. `taken` marks their numbers.
        let mut placed = Vec::new();
        let mut taken = vec![false; n_q + n_v];
        for joints in table.tables("joints")? {
            joints.only(JOINTS)?;
            let selected = elements.select(ElementKind::Joint, &joints.require("joint", "\"target_x\"")?)?;
            if !joints.has("position") && !joints.has("velocity") {
                return Err(joints.error("give position, velocity, or both"));
            }
            for (key, first) in [("position", 0), ("velocity", n_q)] {
                let Some(value) = joints.get(key) else { continue };
                let numbers: Vec<usize> = selected
                    .iter()
                    .flat_map(|&joint| numbers_of(model, joint, first > 0))
                    .map(|at| first + at)
                    .collect();
                let placement = Placement::new(&value, numbers.len())?;
                if numbers.iter().any(|&number| std::mem::replace(&mut taken[number], true)) {
                    return Err(value.error("a joint is placed twice; name it once"));
                }
                placed.push((numbers, placement));
            }
        }
        // Noise applies to all numbers that are not placed by a rule.
        let mut noise = Vec::new();
        for (key, numbers) in [("position", 0..n_q), ("velocity", n_q..n_q + n_v)] {
            let Some(value) = table.get(key) else { continue };
            let kind = Noise::new(&value.table()?)?;
            noise.extend(numbers.filter(|&number| !taken[number]).map(|number| (number, kind)));
        }
        Ok(Self { base, noise, placed })
    }

    /// Draws an initial state, and writes its positions and velocities to `qpos` and `qvel`.
    pub(super) fn draw(&self, stream: &mut PhiloxStream, qpos: &mut [f64], qvel: &mut [f64]) {
        let mut state = self.base.clone();
        for &(number, noise) in &self.noise {
            state[number] += noise.draw(stream);
        }
        for (numbers, placement) in &self.placed {
            placement.draw(stream, numbers, &mut state);
        }
        let (positions, velocities) = state.split_at(qpos.len());
        qpos.copy_from_slice(positions);
        qvel.copy_from_slice(velocities);
    }
}

/// Returns the indices of a joint's entries in `qpos`, or in `qvel` if `velocity`.
fn numbers_of(model: &Model, joint: usize, velocity: bool) -> std::ops::Range<usize> {
    let (starts, end) = if velocity {
        (model.index_array(Index::JointVelocity), model.n_v())
    } else {
        (model.index_array(Index::JointPosition), model.n_q())
    };
    let next = starts.get(joint + 1).map_or(end, |&next| next as usize);
    starts[joint] as usize..next
}

impl Noise {
    fn new(table: &TomlTable<'_>) -> Result<Self> {
        table.only(NOISE)?;
        let (key, value) = table.one_of(&["uniform", "normal"])?;
        let size = non_negative(&value)?;
        Ok(if key == "uniform" { Self::Uniform(size) } else { Self::Normal(size) })
    }

    fn draw(self, stream: &mut PhiloxStream) -> f64 {
        match self {
            Self::Uniform(size) => stream.uniform(-size, size),
            Self::Normal(size) => size * normal_quantile(stream.unit()),
        }
    }
}

impl Placement {
    /// Reads the rule for drawing `n` numbers.
    fn new(value: &Value<'_>, n: usize) -> Result<Self> {
        if value.is_list() {
            let (low, high) = value.interval()?;
            return Ok(Self::Interval(low, high));
        }
        if !value.is_table() {
            return Ok(Self::Fixed(value.number()?));
        }
        let table = value.table()?;
        table.only(PLACEMENT)?;
        let (key, value) = table.one_of(&["uniform", "normal", "disc", "box"])?;
        if let Some(beyond) = table.get("beyond").filter(|_| key != "box") {
            return Err(beyond.error("beyond goes with box"));
        }
        match key {
            "uniform" | "normal" => Ok(Self::Noise(Noise::new(&table)?)),
            "disc" if n == 2 => Ok(Self::Disc(non_negative(&value)?)),
            "disc" => Err(value.error(format_args!("a disc has two numbers, but these joints have {n}"))),
            _ => {
                let sides = value.list()?.iter().map(Value::interval).collect::<Result<Vec<_>>>()?;
                if sides.len() != n {
                    let problem = format!("the box has {} sides, but these joints have {n} numbers", sides.len());
                    return Err(value.error(problem));
                }
                let beyond = table.get("beyond").map(|value| non_negative(&value)).transpose()?.unwrap_or(0.0);
                let farthest: f64 = sides.iter().map(|(low, high)| low.abs().max(high.abs())).map(|x| x * x).sum();
                if farthest.sqrt() <= beyond {
                    return Err(table.error(format_args!("no point of the box is farther than {beyond} from 0")));
                }
                Ok(Self::Box(sides, beyond))
            }
        }
    }

    fn draw(&self, stream: &mut PhiloxStream, numbers: &[usize], state: &mut [f64]) {
        match self {
            Self::Noise(noise) => numbers.iter().for_each(|&number| state[number] += noise.draw(stream)),
            Self::Fixed(value) => numbers.iter().for_each(|&number| state[number] = *value),
            Self::Interval(low, high) => {
                numbers.iter().for_each(|&number| state[number] = stream.uniform(*low, *high));
            }
            Self::Disc(radius) => {
                let distance = radius * stream.unit().sqrt();
                let (sin, cos) = libm::sincos(TAU * stream.unit());
                if let [x, y] = *numbers {
                    (state[x], state[y]) = (distance * cos, distance * sin);
                }
            }
            Self::Box(sides, beyond) => {
                for _ in 0..MAX_DRAWS {
                    for (&number, &(low, high)) in numbers.iter().zip(sides) {
                        state[number] = stream.uniform(low, high);
                    }
                    let distance = numbers.iter().map(|&number| state[number] * state[number]).sum::<f64>().sqrt();
                    if distance > *beyond {
                        break;
                    }
                }
            }
        }
    }
}

fn non_negative(value: &Value<'_>) -> Result<f64> {
    let size = value.number()?;
    if size >= 0.0 { Ok(size) } else { Err(value.error(format_args!("{size} is negative; expected 0 or more"))) }
}

/// Returns the quantile of the standard normal distribution for probability `p` in [0, 1), by Wichura's algorithm AS
/// 241 (1988), which Python's `statistics.NormalDist` uses, too. Probability 0 counts as 2^-54.
#[expect(clippy::excessive_precision, reason = "the published coefficients")]
fn normal_quantile(p: f64) -> f64 {
    // Coefficients (numerator, denominator) of the rational approximations for three ranges of the probability, highest
    // power first.
    const CENTRE: ([f64; 8], [f64; 8]) = (
        [
            2.5090809287301226727e+3,
            3.3430575583588128105e+4,
            6.7265770927008700853e+4,
            4.5921953931549871457e+4,
            1.3731693765509461125e+4,
            1.9715909503065514427e+3,
            1.3314166789178437745e+2,
            3.3871328727963666080e+0,
        ],
        [
            5.2264952788528545610e+3,
            2.8729085735721942674e+4,
            3.9307895800092710610e+4,
            2.1213794301586595867e+4,
            5.3941960214247511077e+3,
            6.8718700749205790830e+2,
            4.2313330701600911252e+1,
            1.0,
        ],
    );
    const MIDDLE: ([f64; 8], [f64; 8]) = (
        [
            7.74545014278341407640e-4,
            2.27238449892691845833e-2,
            2.41780725177450611770e-1,
            1.27045825245236838258e+0,
            3.64784832476320460504e+0,
            5.76949722146069140550e+0,
            4.63033784615654529590e+0,
            1.42343711074968357734e+0,
        ],
        [
            1.05075007164441684324e-9,
            5.47593808499534494600e-4,
            1.51986665636164571966e-2,
            1.48103976427480074590e-1,
            6.89767334985100004550e-1,
            1.67638483018380384940e+0,
            2.05319162663775882187e+0,
            1.0,
        ],
    );
    const TAIL: ([f64; 8], [f64; 8]) = (
        [
            2.01033439929228813265e-7,
            2.71155556874348757815e-5,
            1.24266094738807843860e-3,
            2.65321895265761230930e-2,
            2.96560571828504891230e-1,
            1.78482653991729133580e+0,
            5.46378491116411436990e+0,
            6.65790464350110377720e+0,
        ],
        [
            2.04426310338993978564e-15,
            1.42151175831644588870e-7,
            1.84631831751005468180e-5,
            7.86869131145613259100e-4,
            1.48753612908506148525e-2,
            1.36929880922735805310e-1,
            5.99832206555887937690e-1,
            1.0,
        ],
    );
    let ratio = |(above, below): ([f64; 8], [f64; 8]), x: f64| {
        let polynomial = |factors: [f64; 8]| factors.into_iter().reduce(|sum, factor| sum * x + factor).unwrap_or(0.0);
        polynomial(above) / polynomial(below)
    };
    // If `p` is near 1/2, the quantile is computed from q = p - 1/2, otherwise from the logarithm of the tail's
    // probability.
    let p = p.max(1.0 / (1u64 << 54) as f64);
    let q = p - 0.5;
    if q.abs() <= 0.425 {
        return ratio(CENTRE, 0.180625 - q * q) * q;
    }
    let r = (-libm::log(if q <= 0.0 { p } else { 1.0 - p })).sqrt();
    let x = if r <= 5.0 { ratio(MIDDLE, r - 1.6) } else { ratio(TAIL, r - 5.0) };
    if q < 0.0 { -x } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::DrawPurpose;

    #[test]
    fn normal_quantiles_are_those_of_python() {
        // The quantiles `x` come from `statistics.NormalDist().inv_cdf` of Python 3.11.
        for (p, x) in [
            (0.5, 0.0),
            (0.1, -1.2815515655446008),
            (0.975, 1.9599639845400536),
            (1e-5, -4.264890793922824),
            (1e-15, -7.941345326170998),
            (0.999999, 4.753424308817087),
        ] {
            assert!((normal_quantile(p) - x).abs() <= 1e-12 * x.abs(), "{p}: {} {x}", normal_quantile(p));
        }
        assert!(normal_quantile(0.0).is_finite());
    }

    #[test]
    fn draws_fill_discs_and_stay_within_discs_and_boxes() {
        let mut stream = PhiloxStream::new(1, 2, DrawPurpose::InitialState, 3);
        let (mut state, mut largest) = ([0.0; 2], 0.0f64);
        for _ in 0..1000 {
            Placement::Disc(0.2).draw(&mut stream, &[0, 1], &mut state);
            let distance = state[0].hypot(state[1]);
            assert!(distance <= 0.2);
            largest = largest.max(distance);
            Placement::Box(vec![(-0.3, 0.0), (-0.2, 0.2)], 0.17).draw(&mut stream, &[0, 1], &mut state);
            assert!(state[0].hypot(state[1]) > 0.17 && state[0] <= 0.0 && state[1].abs() <= 0.2);
        }
        assert!(largest > 0.19, "{largest}");
    }
}
