//! The analytic tasks' pictures, after those of Gymnasium. Lengths are true: a longer pole looks longer.

use super::{
    Error, Size,
    canvas::{Canvas, Colour, Point, colour},
};
use std::f64::consts::{FRAC_PI_2, PI};

/// Points of an arc or a curve.
const SMOOTH: usize = 64;

fn canvas(environment: &'static str, size: Size, low: Point, high: Point) -> Result<Canvas, Error> {
    let reason = || format!("a picture of {} × {} pixels has no room", size.width, size.height);
    Canvas::new(size, low, high).ok_or_else(|| Error::Failed { environment, reason: reason() })
}

/// The point at a distance from `from`, in the direction of an angle from +x.
fn polar(from: Point, distance: f64, angle: f64) -> Point {
    let (sin, cos) = angle.sin_cos();
    [from[0] + distance * cos, from[1] + distance * sin]
}

fn arc(centre: Point, radius: f64, from: f64, to: f64) -> Vec<Point> {
    (0..=SMOOTH).map(|i| polar(centre, radius, from + (to - from) * i as f64 / SMOOTH as f64)).collect()
}

/// A rod with a bright outline that sets it off from what is behind.
fn rod(canvas: &mut Canvas, from: Point, to: Point, width: f64, colour: Colour) {
    canvas.line(&[from, to], 1.25 * width, colour::BACKGROUND);
    canvas.line(&[from, to], width, colour);
}

/// A joint: a dark disc with a bright middle.
fn joint(canvas: &mut Canvas, at: Point, radius: f64) {
    canvas.disc(at, radius, colour::DARK);
    canvas.disc(at, 0.45 * radius, colour::BACKGROUND);
}

/// A cart on its track between two posts, the pole, and the angles at which it counts as fallen.
pub(super) fn cart_pole(
    size: Size,
    position: f64,
    angle: f64,
    half_pole_length: f64,
    (position_limit, angle_limit): (f64, f64),
) -> Result<Vec<u8>, Error> {
    const CART: Point = [0.25, 0.22]; // half width, height
    const WHEEL: f64 = 0.07;
    const POLE: f64 = 0.09;
    let hinge = [position, WHEEL + CART[1] - 0.04];
    let pole = 2.0 * half_pole_length;
    let side = position_limit + 0.45;
    let mut canvas = canvas("CartPole", size, [-side, -0.6], [side, (hinge[1] + pole + 0.3).max(2.6)])?;

    let (low, high) = (canvas.low, canvas.high);
    canvas.rectangle(low, [high[0], 0.0], colour::GROUND);
    canvas.line(&[[low[0], 0.0], [high[0], 0.0]], 0.025, colour::DARK);
    for metre in -2..=2 {
        canvas.line(&[[metre.into(), -0.02], [metre.into(), -0.1]], 0.02, colour::DARK);
    }
    for limit in [-position_limit, position_limit] {
        canvas.rectangle([limit - 0.03, -0.1], [limit + 0.03, 0.5], colour::VERMILLION);
    }
    for limit in [-angle_limit, angle_limit] {
        canvas.dashes(&[hinge, polar(hinge, pole, FRAC_PI_2 - limit)], 0.015, colour::FAINT);
    }
    let [half, height] = CART;
    canvas.rectangle([position - half, WHEEL], [position + half, WHEEL + height], colour::BLUE);
    for wheel in [-0.6 * half, 0.6 * half] {
        joint(&mut canvas, [position + wheel, WHEEL], WHEEL);
    }
    rod(&mut canvas, hinge, polar(hinge, pole, FRAC_PI_2 - angle), POLE, colour::ORANGE);
    joint(&mut canvas, hinge, 0.055);
    Ok(canvas.into_rgb())
}

/// A car on the road between two hills, and the flag it has to reach.
pub(super) fn mountain_car(size: Size, position: f64, (low, high): (f64, f64), goal: f64) -> Result<Vec<u8>, Error> {
    const CAR: Point = [0.09, 0.075]; // half length, height
    const WHEEL: f64 = 0.03;
    let road = |x: f64| 0.45 * (3.0 * x).sin() + 0.55;
    let slope = |x: f64| 1.35 * (3.0 * x).cos();
    let mut canvas = canvas("MountainCar", size, [low - 0.06, -0.08], [high + 0.06, 1.32])?;

    // The left end of the road is a wall.
    let (bottom, top) = (canvas.low, canvas.high);
    let curve: Vec<Point> =
        (0..=SMOOTH).map(|i| low + (top[0] - low) * i as f64 / SMOOTH as f64).map(|x| [x, road(x)]).collect();
    let mut hills = curve.clone();
    hills.extend([[top[0], bottom[1]], [low, bottom[1]]]);
    canvas.polygon(&hills, colour::GROUND);
    canvas.rectangle(bottom, [low, top[1]], colour::GROUND);
    canvas.line(&curve, 0.012, colour::DARK);
    canvas.line(&[[low, road(low)], [low, top[1]]], 0.012, colour::DARK);

    let foot = [goal, road(goal)];
    canvas.line(&[foot, [goal, foot[1] + 0.24]], 0.012, colour::DARK);
    canvas.polygon(&[[goal, foot[1] + 0.24], [goal + 0.1, foot[1] + 0.2], [goal, foot[1] + 0.16]], colour::GREEN);

    // The car's frame: along the road, and up from it.
    let along = slope(position).atan();
    let at = |x: f64, y: f64| polar(polar([position, road(position)], x, along), y, along + FRAC_PI_2);
    let [half, height] = CAR;
    let (sill, roof) = (0.8 * WHEEL, 0.8 * WHEEL + height);
    canvas.polygon(&[at(-half, sill), at(half, sill), at(half, 0.6 * roof), at(-half, 0.6 * roof)], colour::BLUE);
    let cabin = [at(-0.7 * half, 0.6 * roof), at(0.6 * half, 0.6 * roof), at(0.3 * half, roof), at(-0.5 * half, roof)];
    canvas.polygon(&cabin, colour::SKY_BLUE);
    for wheel in [-0.6 * half, 0.6 * half] {
        joint(&mut canvas, at(wheel, WHEEL), WHEEL);
    }
    Ok(canvas.into_rgb())
}

/// Two links below a pivot, and the height that the tip has to reach.
pub(super) fn acrobot(size: Size, angles: [f64; 2], link_length: f64, goal_height: f64) -> Result<Vec<u8>, Error> {
    const LINK: f64 = 0.2;
    let half = (2.2 * link_length).max(3.3); // the longest links of version E have room
    let mut canvas = canvas("Acrobot", size, [-half, -half], [half, half])?;

    let (low, high) = (canvas.low, canvas.high);
    canvas.rectangle([low[0], goal_height], high, colour::PALE_GREEN);
    canvas.dashes(&[[low[0], goal_height], [high[0], goal_height]], 0.05, colour::GREEN);
    let pivot = [0.0, 0.0];
    let first = angles[0] - FRAC_PI_2;
    let elbow = polar(pivot, link_length, first);
    let tip = polar(elbow, link_length, first + angles[1]);
    rod(&mut canvas, pivot, elbow, LINK, colour::BLUE);
    rod(&mut canvas, elbow, tip, LINK, colour::ORANGE);
    joint(&mut canvas, pivot, 0.12);
    joint(&mut canvas, elbow, 0.1);
    canvas.disc(tip, 0.07, colour::VERMILLION);
    Ok(canvas.into_rgb())
}

/// A rod on a pivot, the angles within which it counts as held, and an arrow for the torque of the last step.
pub(super) fn pendulum(
    size: Size,
    angle: f64,
    length: f64,
    upright: f64,
    torque: Option<f64>,
) -> Result<Vec<u8>, Error> {
    const ROD: f64 = 0.16;
    const RADIUS: f64 = 0.36;
    const MOST_TURN: f64 = 0.75 * PI;
    let half = (1.2 * length).max(1.8); // the longest rod of version E has room
    let mut canvas = canvas("Pendulum", size, [-half, -half], [half, half])?;

    let pivot = [0.0, 0.0];
    let mut held = arc(pivot, length + ROD, FRAC_PI_2 - upright, FRAC_PI_2 + upright);
    held.push(pivot);
    canvas.polygon(&held, colour::PALE_GREEN);
    canvas.dashes(&[pivot, [0.0, length + ROD]], 0.02, colour::GREEN);
    rod(&mut canvas, pivot, polar(pivot, length, FRAC_PI_2 + angle), ROD, colour::VERMILLION);
    // None is drawn of a torque that is next to nothing: its arrow would have a head all the same.
    if let Some(torque) = torque.filter(|torque| torque.abs() > 0.01) {
        // From below the pivot, in the direction of the turn, as far as the torque is large.
        let turn = MOST_TURN * torque;
        let (start, end) = (-FRAC_PI_2 - 0.5 * turn, -FRAC_PI_2 + 0.5 * turn);
        canvas.line(&arc(pivot, RADIUS, start, end), 0.035, colour::BLUE);
        let forward = turn.signum() * 0.3;
        let head =
            [polar(pivot, RADIUS - 0.09, end), polar(pivot, RADIUS + 0.09, end), polar(pivot, RADIUS, end + forward)];
        canvas.polygon(&head, colour::BLUE);
    }
    joint(&mut canvas, pivot, 0.07);
    Ok(canvas.into_rgb())
}
