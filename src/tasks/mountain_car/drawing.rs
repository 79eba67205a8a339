//! The picture of MountainCar: a car on the road between two hills, and the flag that it has to reach.

use super::{GOAL_POSITION, MAX_POSITION, MIN_POSITION};
use crate::scene::{Drawing, Graph, ScenePoint, colour, polar};
use std::f64::consts::FRAC_PI_2;

const CAR: ScenePoint = [0.09, 0.075]; // half length, height
const WHEEL: f64 = 0.03;

#[expect(clippy::disallowed_methods, reason = "a picture need not be the same everywhere")]
fn road(x: f64) -> f64 {
    0.45 * (3.0 * x).sin() + 0.55
}

#[expect(clippy::disallowed_methods, reason = "a picture need not be the same everywhere")]
fn slope(x: f64) -> f64 {
    1.35 * (3.0 * x).cos()
}

pub(super) fn drawing(position: f64) -> Drawing {
    let mut drawing = Drawing::new([MIN_POSITION - 0.06, -0.08], [MAX_POSITION + 0.06, 1.32]);

    // The left end of the road is a wall.
    let hills = Graph { height: road, from: MIN_POSITION, to: f64::INFINITY };
    drawing.ground(hills, colour::GROUND);
    drawing.rectangle([f64::NEG_INFINITY; 2], [MIN_POSITION, f64::INFINITY], colour::GROUND);
    drawing.graph(hills, 0.012, colour::DARK);
    drawing.line(&[[MIN_POSITION, road(MIN_POSITION)], [MIN_POSITION, f64::INFINITY]], 0.012, colour::DARK);

    let [x, y] = [GOAL_POSITION, road(GOAL_POSITION)];
    drawing.line(&[[x, y], [x, y + 0.24]], 0.012, colour::DARK);
    drawing.polygon(&[[x, y + 0.24], [x + 0.1, y + 0.2], [x, y + 0.16]], colour::GREEN);

    // Converts coordinates in the car's frame to coordinates in the picture. In the car's frame, x is along the road
    // and y perpendicular to the road.
    let along = slope(position).atan();
    let at = |x: f64, y: f64| polar(polar([position, road(position)], x, along), y, along + FRAC_PI_2);
    let [half, height] = CAR;
    let (sill, roof) = (0.8 * WHEEL, 0.8 * WHEEL + height);
    drawing.polygon(&[at(-half, sill), at(half, sill), at(half, 0.6 * roof), at(-half, 0.6 * roof)], colour::BLUE);
    let cabin = [at(-0.7 * half, 0.6 * roof), at(0.6 * half, 0.6 * roof), at(0.3 * half, roof), at(-0.5 * half, roof)];
    drawing.polygon(&cabin, colour::SKY_BLUE);
    for wheel in [-0.6 * half, 0.6 * half] {
        drawing.joint(at(wheel, WHEEL), WHEEL);
    }
    drawing
}
