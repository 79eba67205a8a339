//! The picture of Pendulum: a rod on a pivot, the range of angles that counts as upright, and an arrow for the torque
//! of the last step.

use super::{MAX_TORQUE, UPRIGHT};
use crate::scene::{Drawing, ScenePoint, colour, polar};
use std::f64::consts::{FRAC_PI_2, PI};

/// Width of the drawn rod, in m.
const ROD: f64 = 0.16;
/// Radius of the arrow that shows the torque, in m.
const RADIUS: f64 = 0.36;
/// Angle of the arrow for the maximal torque, in rad.
const MAX_TURN: f64 = 0.75 * PI;
/// Number of straight segments by which an arc is drawn.
const SMOOTH: usize = 64;

fn arc(centre: ScenePoint, radius: f64, from: f64, to: f64) -> Vec<ScenePoint> {
    (0..=SMOOTH).map(|i| polar(centre, radius, from + (to - from) * i as f64 / SMOOTH as f64)).collect()
}

/// Draws the rod. `angle` is in rad from upright, anticlockwise, `length` in m. `torque` is the torque of the last step
/// in N m; `None` after a reset.
pub(super) fn drawing(angle: f64, length: f64, torque: Option<f64>) -> Drawing {
    let half = (1.2 * length).max(1.8); // the longest rod of version E fits
    let mut drawing = Drawing::new([-half, -half], [half, half]);

    let pivot = [0.0, 0.0];
    let mut held = arc(pivot, length + ROD, FRAC_PI_2 - UPRIGHT, FRAC_PI_2 + UPRIGHT);
    held.push(pivot);
    drawing.polygon(&held, colour::PALE_GREEN);
    drawing.dashes(&[pivot, [0.0, length + ROD]], 0.02, colour::GREEN);
    drawing.rod(pivot, polar(pivot, length, FRAC_PI_2 + angle), ROD, colour::VERMILLION);
    // A very small torque gets no arrow, because the arrow's head has a fixed size and would be too large.
    let share = torque.map(|torque| torque / MAX_TORQUE);
    if let Some(share) = share.filter(|share| share.abs() > 0.01) {
        // The arrow is an arc below the pivot, in the direction of the torque. Its length shows the torque's size.
        let turn = MAX_TURN * share;
        let (start, end) = (-FRAC_PI_2 - 0.5 * turn, -FRAC_PI_2 + 0.5 * turn);
        drawing.line(&arc(pivot, RADIUS, start, end), 0.035, colour::BLUE);
        let forward = turn.signum() * 0.3;
        let head =
            [polar(pivot, RADIUS - 0.09, end), polar(pivot, RADIUS + 0.09, end), polar(pivot, RADIUS, end + forward)];
        drawing.polygon(&head, colour::BLUE);
    }
    drawing.joint(pivot, 0.07);
    drawing
}
