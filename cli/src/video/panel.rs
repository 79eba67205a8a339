//! What is written below a picture: which episode it is, with which parameters, and how it goes.

use std::ops::RangeInclusive;

use perturb_learner::client::Picture;
use perturb_protocol::limits::PICTURE_PIXELS;
use perturb_report::plot::{FAMILY, PlotError, drawing, is_dark, load_font};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::VideoError;

/// Width and height of a picture: below them nothing could be read, above them a server draws none.
pub const PIXELS: RangeInclusive<u32> = 240..=*PICTURE_PIXELS.end() as u32;

/// A letter is so many times smaller than a picture is wide.
const LETTERS: u32 = 30;
const GROUND: RGBColor = RGBColor(28, 30, 36);
const INK: RGBColor = RGBColor(236, 236, 236);
const PALE: RGBColor = RGBColor(168, 172, 180);
// Bluish green and vermilion of Okabe and Ito, which people with any colour vision tell apart.
const SUCCESS: RGBColor = RGBColor(0, 158, 115);
const NO_SUCCESS: RGBColor = RGBColor(213, 94, 0);

/// A line of text: what stands on its left, and on its right.
type PanelLine = (String, String);

/// How an episode ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ShownEnding {
    pub(super) success: bool,
    pub(super) terminated: bool,
    pub(super) truncated: bool,
}

impl ShownEnding {
    fn text(self) -> String {
        let mut words = vec![if self.success { "success" } else { "no success" }];
        words.extend(self.terminated.then_some("terminated"));
        words.extend(self.truncated.then_some("truncated"));
        words.join(", ")
    }
}

/// What changes from frame to frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Shown {
    /// e.g. "episode 1 of 3".
    pub(super) episode: String,
    /// The episode's parameters, e.g. "length 0.5 m".
    pub(super) parameters: Vec<String>,
    pub(super) step: u32,
    /// Simulated seconds.
    pub(super) time: f64,
    /// The sum of the rewards so far.
    pub(super) episode_return: f64,
    /// `None` while it goes on.
    pub(super) ending: Option<ShownEnding>,
    /// What it achieved of what decides about success, once it has ended, e.g. "distance 20.3 m"; empty if nothing.
    pub(super) achieved: String,
}

/// Makes frames of pictures: the picture, and below it the panel. Both sides of a frame are even, as H.264 wants them.
pub(super) struct Panel {
    /// Of the picture.
    picture: (u32, u32),
    /// Of the frame.
    frame: (u32, u32),
    title: PanelLine,
    /// What is a success.
    rule: String,
    letter: u32,
}

impl Panel {
    /// For pictures of `width` and `height`, of an environment with so many `parameters`. `title` stands above all else, on
    /// the left and on the right, and `rule` says what is a success.
    pub(super) fn new(
        (width, height): (u32, u32),
        title: PanelLine,
        rule: String,
        parameters: usize,
    ) -> Result<Self, VideoError> {
        load_font()?;
        let letter = (width / LETTERS).max(10);
        let lines = 4 + parameters.div_ceil(2) as u32;
        let even = |pixels: u32| pixels + pixels % 2;
        let frame = (even(width), even(height + lines * line_height(letter) + letter));
        Ok(Self { picture: (width, height), frame, title, rule, letter })
    }

    /// Width and height of frames.
    pub(super) fn size(&self) -> (u32, u32) {
        self.frame
    }

    /// Writes the frame `[height, width, 3]`.
    pub(super) fn compose(&self, picture: &Picture, shown: &Shown, frame: &mut Vec<u8>) -> Result<(), VideoError> {
        let ((width, height), (frame_width, frame_height)) = (self.picture, self.frame);
        frame.clear();
        let ground = [GROUND.0, GROUND.1, GROUND.2];
        for row in picture.pixels.chunks_exact(width as usize * 3) {
            frame.extend_from_slice(row);
            if frame_width > width {
                frame.extend_from_slice(&ground);
            }
        }
        let below = frame.len();
        let pixels = (frame_height - height) as usize * frame_width as usize;
        frame.extend(std::iter::repeat_n(ground, pixels).flatten());
        Ok(self.write(&mut frame[below..], shown)?)
    }

    fn write(&self, panel: &mut [u8], shown: &Shown) -> Result<(), PlotError> {
        let (width, height) = (self.frame.0 as i32, self.frame.1 - self.picture.1);
        let area = BitMapBackend::with_buffer(panel, (self.frame.0, height)).into_drawing_area();
        let mut lines: Vec<(PanelLine, RGBColor)> = vec![
            (self.title.clone(), PALE),
            ((shown.episode.clone(), format!("{:.2} s, step {}", shown.time, shown.step)), INK),
            ((format!("return {:.1}", shown.episode_return), String::new()), INK),
            ((self.rule.clone(), shown.achieved.clone()), PALE),
        ];
        lines.extend(shown.parameters.chunks(2).map(|pair| {
            let mut pair = pair.iter().cloned();
            ((pair.next().unwrap_or_default(), pair.next().unwrap_or_default()), INK)
        }));
        let margin = self.letter as i32;
        let font = |colour: &RGBColor, side| {
            let style: TextStyle<'_> = (FAMILY, self.letter).into_font().color(colour);
            style.pos(Pos::new(side, VPos::Top))
        };
        let mut y = margin / 2 + margin / 4;
        for (number, ((left, right), colour)) in lines.iter().enumerate() {
            let draw = |text: &str, side, x| area.draw_text(text, &font(colour, side), (x, y));
            draw(left, HPos::Left, margin).and_then(|()| draw(right, HPos::Right, width - margin)).map_err(drawing)?;
            if let (2, Some(ending)) = (number, shown.ending) {
                let ground = if ending.success { SUCCESS } else { NO_SUCCESS };
                let ink = if is_dark((ground.0, ground.1, ground.2)) { WHITE } else { BLACK };
                let (text, style) = (ending.text(), font(&ink, HPos::Right));
                let (text_width, _) = area.estimate_text_size(&text, &style).map_err(drawing)?;
                let corners = [
                    (width - margin * 2 - text_width as i32, y - margin * 2 / 5),
                    (width - margin, y + margin * 3 / 4),
                ];
                area.draw(&Rectangle::new(corners, ground.filled())).map_err(drawing)?;
                area.draw_text(&text, &style, (width - margin * 3 / 2, y)).map_err(drawing)?;
            }
            y += line_height(self.letter) as i32;
        }
        area.present().map_err(drawing)
    }
}

/// From one line to the next, in pixels.
fn line_height(letter: u32) -> u32 {
    letter * 7 / 5
}

/// A parameter with its unit, to four digits: "density 1180 kg/m³".
pub(super) fn parameter(name: &str, value: f64, unit: &str) -> String {
    let unit = if unit == "1" { String::new() } else { format!(" {unit}") };
    let value = value + 0.0; // not -0
    let magnitude = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    let digits = (3.0 - magnitude).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.digits$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{name} {text}{unit}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shown() -> Shown {
        Shown {
            episode: "episode 1 of 3".into(),
            parameters: vec!["power 0.9".into(), "density 1180 kg/m³".into(), "friction 0.8".into()],
            step: 12,
            time: 0.198,
            episode_return: 34.5,
            ending: None,
            achieved: String::new(),
        }
    }

    fn panel(size: (u32, u32)) -> Panel {
        let title = ("Hopper E".into(), "ppo ff, trained on D".into());
        Panel::new(size, title, "success: distance at least 20 m".into(), 3).unwrap()
    }

    fn frame(panel: &Panel, shown: &Shown) -> Vec<u8> {
        let (width, height) = panel.picture;
        let pixels = vec![255; (width * height * 3) as usize].into();
        let mut frame = vec![1, 2, 3];
        panel.compose(&Picture { width, height, pixels }, shown, &mut frame).unwrap();
        frame
    }

    #[test]
    fn a_frame_is_the_picture_with_the_panel_below_and_has_even_sides() {
        for size in [(240, 240), (241, 243), (480, 300), (2048, 2048)] {
            let panel = panel(size);
            let (width, height) = panel.size();
            assert!(width % 2 == 0 && height % 2 == 0 && width - size.0 < 2 && height > size.1, "{size:?}");
            let frame = frame(&panel, &shown());
            assert_eq!(frame.len(), (width * height * 3) as usize);
            let rows: Vec<&[u8]> = frame.chunks(width as usize * 3).collect();
            let white = |row: &&[u8]| row[..size.0 as usize * 3].iter().all(|&byte| byte == 255);
            assert!(rows[..size.1 as usize].iter().all(white), "the picture is not written over");
            assert!(!rows[size.1 as usize..].iter().any(white), "the panel is dark");
        }
    }

    #[test]
    fn everything_that_is_shown_is_seen() {
        let panel = panel((480, 480));
        let plain = frame(&panel, &shown());
        assert_eq!(frame(&panel, &shown()), plain);
        let ending = |success, terminated, truncated| Some(ShownEnding { success, terminated, truncated });
        let others = [
            Shown { episode: "episode 2 of 3".into(), ..shown() },
            Shown {
                parameters: vec!["power 0.9".into(), "density 1180 kg/m³".into(), "friction 0.7".into()],
                ..shown()
            },
            Shown { step: 13, ..shown() },
            Shown { time: 0.2145, ..shown() },
            Shown { episode_return: 35.5, ..shown() },
            Shown { ending: ending(true, false, true), ..shown() },
            Shown { ending: ending(false, false, true), ..shown() },
            Shown { ending: ending(false, true, false), ..shown() },
            Shown { ending: ending(false, true, true), ..shown() },
            Shown { achieved: "distance 20.3 m".into(), ..shown() },
        ];
        let frames: std::collections::HashSet<Vec<u8>> =
            others.iter().map(|other| frame(&panel, other)).chain([plain]).collect();
        assert_eq!(frames.len(), others.len() + 1);
    }

    #[test]
    fn parameters_have_four_digits_and_their_unit() {
        let texts = [
            parameter("density", 1180.337, "kg/m³"),
            parameter("length", 0.5, "m"),
            parameter("force", 18.115_54, "N"),
            parameter("force", 0.001, "1"),
            parameter("power", 1.0 / 3.0, "1"),
            parameter("x", -0.0, "1"),
            parameter("x", 123_456.0, "1"),
            parameter("x", -2.0, "m"),
        ];
        let expected = [
            "density 1180 kg/m³",
            "length 0.5 m",
            "force 18.12 N",
            "force 0.001",
            "power 0.3333",
            "x 0",
            "x 123456",
            "x -2 m",
        ];
        assert_eq!(texts, expected);
    }
}
