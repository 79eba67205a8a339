//! The picture of Acrobot: two links below a pivot, and the height that the tip has to reach.

use super::HEIGHT;
use crate::scene::{Drawing, colour, polar};
use std::f64::consts::FRAC_PI_2;

/// Width of a drawn link, in m.
const LINK: f64 = 0.2;

/// Draws the links. `angles` are the angle of link 1 from hanging down and the angle of link 2 relative to link 1, in
/// rad, anticlockwise. `link_length` is in m.
pub(super) fn drawing(angles: [f64; 2], link_length: f64) -> Drawing {
    let half = (2.2 * link_length).max(3.3); // the longest links of version E fit
    let mut drawing = Drawing::new([-half, -half], [half, half]);

    // The task compares a sum of two cosines with `HEIGHT`, so the unit of `HEIGHT` is the length of a link.
    let goal_height = HEIGHT * link_length;
    drawing.rectangle([f64::NEG_INFINITY, goal_height], [f64::INFINITY; 2], colour::PALE_GREEN);
    drawing.dashes(&[[f64::NEG_INFINITY, goal_height], [f64::INFINITY, goal_height]], 0.05, colour::GREEN);
    let pivot = [0.0, 0.0];
    let first = angles[0] - FRAC_PI_2;
    let elbow = polar(pivot, link_length, first);
    let tip = polar(elbow, link_length, first + angles[1]);
    drawing.rod(pivot, elbow, LINK, colour::BLUE);
    drawing.rod(elbow, tip, LINK, colour::ORANGE);
    drawing.joint(pivot, 0.12);
    drawing.joint(elbow, 0.1);
    drawing.disc(tip, 0.07, colour::VERMILLION);
    drawing
}
