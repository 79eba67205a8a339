//! The paper's table of parameter ranges (Packer et al., 2018, table 1), with physical bounds of our own.

use super::{Interval, Parameter};

const fn parameter(
    (name, unit, description): (&'static str, &'static str, &'static str),
    default: f64,
    extreme_low: f64,
    random: (f64, f64),
    extreme_high: f64,
    bounds: (f64, f64),
) -> Parameter {
    Parameter {
        name,
        unit,
        description,
        default,
        random: Interval::new(random.0, random.1),
        extreme: [Interval::new(extreme_low, random.0), Interval::new(random.1, extreme_high)],
        bounds: Interval::new(bounds.0, bounds.1),
    }
}

/// CartPole: force, length, mass.
pub const CART_POLE: &[Parameter] = &[
    parameter(("force", "N", "push on the cart"), 10.0, 1.0, (5.0, 15.0), 20.0, (0.0, 1000.0)),
    parameter(("length", "m", "half the pole's length"), 0.5, 0.05, (0.25, 0.75), 1.0, (0.001, 100.0)),
    parameter(("mass", "kg", "the pole's mass"), 0.1, 0.01, (0.05, 0.5), 1.0, (0.0001, 1000.0)),
];

/// MountainCar: force, mass.
pub const MOUNTAIN_CAR: &[Parameter] = &[
    parameter(("force", "1", "the engine's push per step"), 0.001, 0.0001, (0.0005, 0.005), 0.01, (0.0, 1.0)),
    parameter(("mass", "1", "the gravity term's factor"), 0.0025, 0.0005, (0.001, 0.005), 0.01, (0.0, 1.0)),
];

/// Acrobot: length, mass, moi, each for both links.
pub const ACROBOT: &[Parameter] = &[
    parameter(("length", "m", "length of both links"), 1.0, 0.5, (0.75, 1.25), 1.5, (0.01, 100.0)),
    parameter(("mass", "kg", "mass of both links"), 1.0, 0.5, (0.75, 1.25), 1.5, (0.001, 1000.0)),
    parameter(("moi", "kg m²", "moment of inertia of both links"), 1.0, 0.5, (0.75, 1.25), 1.5, (0.001, 1000.0)),
];

/// Pendulum: length, mass.
pub const PENDULUM: &[Parameter] = &[
    parameter(("length", "m", "length of the rod"), 1.0, 0.5, (0.75, 1.25), 1.5, (0.01, 100.0)),
    parameter(("mass", "kg", "mass of the rod"), 1.0, 0.5, (0.75, 1.25), 1.5, (0.001, 1000.0)),
];

const DENSITY: Parameter = parameter(
    ("density", "kg/m³", "density of the torso body"),
    1000.0,
    500.0,
    (750.0, 1250.0),
    1500.0,
    (10.0, 100_000.0),
);
const FRICTION: Parameter =
    parameter(("friction", "1", "sliding friction of the robot's geoms"), 0.8, 0.2, (0.5, 1.1), 1.4, (0.0, 10.0));

/// HalfCheetah: power, density, friction.
pub const HALF_CHEETAH: &[Parameter] = &[
    parameter(("power", "1", "factor on every motor's control"), 0.9, 0.5, (0.7, 1.1), 1.3, (0.0, 10.0)),
    DENSITY,
    FRICTION,
];

/// Hopper: power, density, friction.
pub const HOPPER: &[Parameter] = &[
    parameter(("power", "1", "factor on every motor's control"), 0.75, 0.4, (0.6, 0.9), 1.1, (0.0, 10.0)),
    DENSITY,
    FRICTION,
];
