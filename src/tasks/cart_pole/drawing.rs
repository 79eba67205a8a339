//! The picture of CartPole: a cart on its track between two posts, its pole, and the angles at which the pole counts as
//! fallen.

use super::{ANGLE_LIMIT, POSITION_LIMIT};
use crate::scene::{Drawing, ScenePoint, colour, polar};
use std::f64::consts::FRAC_PI_2;

const CART: ScenePoint = [0.25, 0.22]; // half width, height
const WHEEL: f64 = 0.07;
/// Width of the drawn pole, in m.
const POLE: f64 = 0.09;

/// Draws the cart and its pole. `position` and `half_pole_length` are in m, `angle` is in rad from upright, clockwise.
/// The pole is drawn to scale.
pub(super) fn drawing(position: f64, angle: f64, half_pole_length: f64) -> Drawing {
    let hinge = [position, WHEEL + CART[1] - 0.04];
    let pole = 2.0 * half_pole_length;
    let side = POSITION_LIMIT + 0.45;
    let mut drawing = Drawing::new([-side, -0.6], [side, (hinge[1] + pole + 0.3).max(2.6)]);

    drawing.rectangle([f64::NEG_INFINITY; 2], [f64::INFINITY, 0.0], colour::GROUND);
    drawing.line(&[[f64::NEG_INFINITY, 0.0], [f64::INFINITY, 0.0]], 0.025, colour::DARK);
    for metre in -2..=2 {
        drawing.line(&[[metre.into(), -0.02], [metre.into(), -0.1]], 0.02, colour::DARK);
    }
    for limit in [-POSITION_LIMIT, POSITION_LIMIT] {
        drawing.rectangle([limit - 0.03, -0.1], [limit + 0.03, 0.5], colour::VERMILLION);
    }
    for limit in [-ANGLE_LIMIT, ANGLE_LIMIT] {
        drawing.dashes(&[hinge, polar(hinge, pole, FRAC_PI_2 - limit)], 0.015, colour::FAINT);
    }
    let [half, height] = CART;
    drawing.rectangle([position - half, WHEEL], [position + half, WHEEL + height], colour::BLUE);
    for wheel in [-0.6 * half, 0.6 * half] {
        drawing.joint([position + wheel, WHEEL], WHEEL);
    }
    drawing.rod(hinge, polar(hinge, pole, FRAC_PI_2 - angle), POLE, colour::ORANGE);
    drawing.joint(hinge, 0.055);
    drawing
}
