//! Colours of pictures. Lines use the palette of Okabe and Ito, which people with any colour vision can tell apart.
//! Heatmaps use viridis, whose lightness rises with the value.

use plotters::style::RGBColor;

/// Background colour. On a dark page, `report/style.css` replaces this colour, [`INK`] and [`GRID`]. All other colours
/// are visible on both backgrounds.
pub(super) const PAPER: RGBColor = RGBColor(255, 255, 255);
/// Colour of texts.
pub(super) const INK: RGBColor = RGBColor(34, 34, 34);
/// Colour of the grid behind a chart's lines.
pub(super) const GRID: RGBColor = RGBColor(225, 225, 225);
/// Colour of frames and ticks.
pub(super) const FRAME: RGBColor = RGBColor(120, 120, 120);

/// The colours of lines, after Okabe and Ito (2008). Their black is replaced by [`INK`], for which a dark page has
/// another colour. Their yellow is left out because yellow is hard to see on white.
pub(super) const LINES: [RGBColor; 7] = [
    INK,
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
];

/// Colours of viridis (Smith and van der Walt, 2015) for the values 0, 1/8, … 1. Colours between them are interpolated.
const VIRIDIS: [(u8, u8, u8); 9] = [
    (68, 1, 84),
    (71, 45, 123),
    (59, 82, 139),
    (44, 114, 142),
    (33, 145, 140),
    (40, 174, 128),
    (94, 201, 98),
    (173, 220, 48),
    (253, 231, 37),
];

/// Light to dark blue, for the background of numbers in tables. Text on it stays readable, and printing takes little
/// ink.
const BLUES: [(u8, u8, u8); 5] = [(247, 251, 255), (198, 219, 239), (107, 174, 214), (33, 113, 181), (8, 48, 107)];

/// Returns the background colour of a table cell: from light blue for a `share` of 0 to dark blue for 1.
pub fn shade(share: f64) -> (u8, u8, u8) {
    blend(&BLUES, share)
}

/// Returns the colour of a heatmap: from dark for a `share` of 0 to light for 1.
pub(super) fn viridis(share: f64) -> RGBColor {
    let (r, g, b) = blend(&VIRIDIS, share);
    RGBColor(r, g, b)
}

/// Interpolates linearly between the colours `anchors`, which belong to equally spaced values from 0 to 1. Clamps
/// `share` to this range.
fn blend(anchors: &[(u8, u8, u8)], share: f64) -> (u8, u8, u8) {
    let place = share.clamp(0.0, 1.0) * (anchors.len() - 1) as f64;
    let below = (place as usize).min(anchors.len() - 2);
    let weight = place - below as f64;
    let mix = |low: u8, high: u8| (f64::from(low) * (1.0 - weight) + f64::from(high) * weight).round() as u8;
    let (low, high) = (anchors[below], anchors[below + 1]);
    (mix(low.0, high.0), mix(low.1, high.1), mix(low.2, high.2))
}

/// Returns whether white text has more contrast on this colour than black text.
pub fn is_dark((r, g, b): (u8, u8, u8)) -> bool {
    luminance((r, g, b)) < 0.179 // at this luminance, black and white text have the same contrast
}

/// Returns the relative luminance (0 … 1) of a colour, as WCAG 2 defines it.
fn luminance((r, g, b): (u8, u8, u8)) -> f64 {
    let linear = |channel: u8| {
        let c = f64::from(channel) / 255.0;
        if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    };
    0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn luminance_is_monotonic_in_the_share() {
        let shares: Vec<f64> = (0..=100).map(|i| f64::from(i) / 100.0).collect();
        let rising = |colours: Vec<f64>| colours.windows(2).all(|pair| pair[0] < pair[1]);
        assert!(rising(
            shares
                .iter()
                .map(|&share| {
                    let c = viridis(share);
                    luminance((c.0, c.1, c.2))
                })
                .collect()
        ));
        assert!(rising(shares.iter().rev().map(|&share| luminance(shade(share))).collect()));
        assert_eq!((shade(-1.0), shade(2.0)), (BLUES[0], BLUES[4]));
    }

    #[test]
    fn text_on_a_shade_has_the_contrast_that_wcag_asks_for() {
        for i in 0..=100 {
            let colour = shade(f64::from(i) / 100.0);
            let ink = if is_dark(colour) { 1.0 } else { 0.0 };
            let (light, dark) = (luminance(colour).max(ink), luminance(colour).min(ink));
            assert!((light + 0.05) / (dark + 0.05) >= 4.5, "{i} %");
        }
    }

    /// WCAG requires a contrast of 3 to 1 in graphics. Two colours of the palette have a lower contrast on white. This
    /// is accepted, because lines also differ in their dashes.
    #[test]
    fn lines_are_seen_on_white_and_on_a_dark_page() {
        let dark = luminance((0x17, 0x1a, 0x1d)); // report/style.css
        for colour in LINES.iter().filter(|colour| **colour != INK) {
            let own = luminance((colour.0, colour.1, colour.2));
            assert!(1.05 / (own + 0.05) > 2.0 && (own + 0.05) / (dark + 0.05) > 3.0, "{colour:?}");
        }
    }
}
