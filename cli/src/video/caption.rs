//! The caption below each picture: episode, parameters, return and ending.

use std::ops::RangeInclusive;

use perturb_learner::client::RenderedPicture;
use perturb_protocol::limits::PICTURE_PIXELS;
use perturb_report::plot::{FAMILY, PlotError, drawing, is_dark, load_font};
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

use super::VideoError;

/// Width and height of a picture, in pixels. Captions of smaller pictures are unreadable, and servers refuse larger
/// ones.
pub const PIXELS: RangeInclusive<u32> = 240..=*PICTURE_PIXELS.end() as u32;

/// Width of a picture divided by the font size.
const WIDTH_PER_FONT_SIZE: u32 = 30;
const BACKGROUND: RGBColor = RGBColor(28, 30, 36);
const TEXT: RGBColor = RGBColor(236, 236, 236);
const DIM_TEXT: RGBColor = RGBColor(168, 172, 180);
// Bluish green and vermilion from Okabe and Ito's palette for all kinds of colour vision.
const SUCCESS: RGBColor = RGBColor(0, 158, 115);
const NO_SUCCESS: RGBColor = RGBColor(213, 94, 0);

/// A line of the caption: the text on its left side, and the text on its right side.
type CaptionLine = (String, String);

/// The outcome at the end of an episode.
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

/// The texts and numbers of the caption that change from frame to frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct CaptionText {
    /// Number of the episode, e.g. "episode 1 of 3".
    pub(super) episode: String,
    /// Parameters of the episode, e.g. "length 0.5 m".
    pub(super) parameters: Vec<String>,
    pub(super) step: u32,
    /// Simulated time, in seconds.
    pub(super) time: f64,
    /// Undiscounted sum of the rewards so far.
    pub(super) episode_return: f64,
    /// Outcome of the episode; `None` before its end.
    pub(super) ending: Option<ShownEnding>,
    /// Final value of the quantity that decides about success, e.g. "distance 20.3 m". Empty before the end, and for
    /// environments without such a quantity.
    pub(super) achieved: String,
}

/// Composes frames that consist of a picture and a caption below it. Width and height of a frame are even, because
/// H.264 requires that.
pub(super) struct Caption {
    /// Width and height of the picture, in pixels.
    picture: (u32, u32),
    /// Width and height of the frame, in pixels.
    frame: (u32, u32),
    title: CaptionLine,
    /// Description of the success rule.
    rule: String,
    font_size: u32,
}

impl Caption {
    /// Makes the caption for pictures of `width` and `height` in pixels. `title` is its first line, `rule` describes
    /// the success rule, and `parameters` is the number of the environment's parameters.
    pub(super) fn new(
        (width, height): (u32, u32),
        title: CaptionLine,
        rule: String,
        parameters: usize,
    ) -> Result<Self, VideoError> {
        load_font()?;
        let font_size = (width / WIDTH_PER_FONT_SIZE).max(10);
        let lines = 4 + parameters.div_ceil(2) as u32;
        let even = |pixels: u32| pixels + pixels % 2;
        let frame = (even(width), even(height + lines * line_height(font_size) + font_size));
        Ok(Self { picture: (width, height), frame, title, rule, font_size })
    }

    /// Returns the width and height of a frame, in pixels.
    pub(super) fn size(&self) -> (u32, u32) {
        self.frame
    }

    /// Composes a frame of `picture` and the caption with `text`. Writes its pixels `[height, width, 3]` to `frame`.
    pub(super) fn compose(
        &self,
        picture: &RenderedPicture,
        text: &CaptionText,
        frame: &mut Vec<u8>,
    ) -> Result<(), VideoError> {
        let ((width, height), (frame_width, frame_height)) = (self.picture, self.frame);
        frame.clear();
        let background = [BACKGROUND.0, BACKGROUND.1, BACKGROUND.2];
        for row in picture.pixels.chunks_exact(width as usize * 3) {
            frame.extend_from_slice(row);
            if frame_width > width {
                frame.extend_from_slice(&background);
            }
        }
        let below = frame.len();
        let pixels = (frame_height - height) as usize * frame_width as usize;
        frame.extend(std::iter::repeat_n(background, pixels).flatten());
        Ok(self.write(&mut frame[below..], text)?)
    }

    /// Draws the lines of the caption into its pixels, and a coloured badge with the outcome after the end of an
    /// episode.
    fn write(&self, caption: &mut [u8], text: &CaptionText) -> Result<(), PlotError> {
        let width = self.frame.0 as i32;
        let height = self.frame.1 - self.picture.1;
        let area = BitMapBackend::with_buffer(caption, (self.frame.0, height)).into_drawing_area();
        let mut lines: Vec<(CaptionLine, RGBColor)> = vec![
            (self.title.clone(), DIM_TEXT),
            ((text.episode.clone(), format!("{:.2} s, step {}", text.time, text.step)), TEXT),
            ((format!("return {:.1}", text.episode_return), String::new()), TEXT),
            ((self.rule.clone(), text.achieved.clone()), DIM_TEXT),
        ];
        lines.extend(text.parameters.chunks(2).map(|pair| {
            let mut pair = pair.iter().cloned();
            ((pair.next().unwrap_or_default(), pair.next().unwrap_or_default()), TEXT)
        }));
        let margin = self.font_size as i32;
        let font = |colour: &RGBColor, side| {
            let style: TextStyle<'_> = (FAMILY, self.font_size).into_font().color(colour);
            style.pos(Pos::new(side, VPos::Top))
        };
        let mut y = margin / 2 + margin / 4;
        for (number, ((left, right), colour)) in lines.iter().enumerate() {
            let draw = |text: &str, side, x| area.draw_text(text, &font(colour, side), (x, y));
            draw(left, HPos::Left, margin).and_then(|()| draw(right, HPos::Right, width - margin)).map_err(drawing)?;
            if let (2, Some(ending)) = (number, text.ending) {
                let ground = if ending.success { SUCCESS } else { NO_SUCCESS };
                let ink = if is_dark((ground.0, ground.1, ground.2)) { WHITE } else { BLACK };
                let text = ending.text();
                let style = font(&ink, HPos::Right);
                let (text_width, _) = area.estimate_text_size(&text, &style).map_err(drawing)?;
                let corners = [
                    (width - margin * 2 - text_width as i32, y - margin * 2 / 5),
                    (width - margin, y + margin * 3 / 4),
                ];
                area.draw(&Rectangle::new(corners, ground.filled())).map_err(drawing)?;
                area.draw_text(&text, &style, (width - margin * 3 / 2, y)).map_err(drawing)?;
            }
            y += line_height(self.font_size) as i32;
        }
        area.present().map_err(drawing)
    }
}

/// Returns the height of a line, in pixels.
fn line_height(font_size: u32) -> u32 {
    font_size * 7 / 5
}

/// Formats a parameter with its unit, e.g. "density 1180 kg/m³". The value has at most four significant digits, or all
/// digits before the decimal point if they are more.
pub(super) fn parameter(name: &str, value: f64, unit: &str) -> String {
    let unit = if unit == "1" { String::new() } else { format!(" {unit}") };
    // Adding 0 changes -0 to 0.
    let value = value + 0.0;
    let magnitude = if value == 0.0 { 0.0 } else { value.abs().log10().floor() };
    let digits = (3.0 - magnitude).clamp(0.0, 9.0) as usize;
    let text = format!("{value:.digits$}");
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{name} {text}{unit}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text() -> CaptionText {
        CaptionText {
            episode: "episode 1 of 3".into(),
            parameters: vec!["power 0.9".into(), "density 1180 kg/m³".into(), "friction 0.8".into()],
            step: 12,
            time: 0.198,
            episode_return: 34.5,
            ending: None,
            achieved: String::new(),
        }
    }

    fn caption(size: (u32, u32)) -> Caption {
        let title = ("Hopper E".into(), "ppo ff, trained on D".into());
        Caption::new(size, title, "success: distance at least 20 m".into(), 3).unwrap()
    }

    fn frame(caption: &Caption, text: &CaptionText) -> Vec<u8> {
        let (width, height) = caption.picture;
        let pixels = vec![255; (width * height * 3) as usize].into();
        let mut frame = vec![1, 2, 3];
        caption.compose(&RenderedPicture { width, height, pixels }, text, &mut frame).unwrap();
        frame
    }

    #[test]
    fn a_frame_is_a_picture_with_a_caption_and_even_sides() {
        for size in [(240, 240), (241, 243), (480, 300), (2048, 2048)] {
            let caption = caption(size);
            let (width, height) = caption.size();
            assert!(width % 2 == 0 && height % 2 == 0 && width - size.0 < 2 && height > size.1, "{size:?}");
            let frame = frame(&caption, &text());
            assert_eq!(frame.len(), (width * height * 3) as usize);
            let rows: Vec<&[u8]> = frame.chunks(width as usize * 3).collect();
            let white = |row: &&[u8]| row[..size.0 as usize * 3].iter().all(|&byte| byte == 255);
            assert!(rows[..size.1 as usize].iter().all(white), "the picture is unchanged");
            assert!(!rows[size.1 as usize..].iter().any(white), "the caption is dark");
        }
    }

    #[test]
    fn every_part_of_the_caption_changes_the_frame() {
        let caption = caption((480, 480));
        let plain = frame(&caption, &text());
        assert_eq!(frame(&caption, &text()), plain);
        let ending = |success, terminated, truncated| Some(ShownEnding { success, terminated, truncated });
        let others = [
            CaptionText { episode: "episode 2 of 3".into(), ..text() },
            CaptionText {
                parameters: vec!["power 0.9".into(), "density 1180 kg/m³".into(), "friction 0.7".into()],
                ..text()
            },
            CaptionText { step: 13, ..text() },
            CaptionText { time: 0.2145, ..text() },
            CaptionText { episode_return: 35.5, ..text() },
            CaptionText { ending: ending(true, false, true), ..text() },
            CaptionText { ending: ending(false, false, true), ..text() },
            CaptionText { ending: ending(false, true, false), ..text() },
            CaptionText { ending: ending(false, true, true), ..text() },
            CaptionText { achieved: "distance 20.3 m".into(), ..text() },
        ];
        let frames: std::collections::HashSet<Vec<u8>> =
            others.iter().map(|other| frame(&caption, other)).chain([plain]).collect();
        assert_eq!(frames.len(), others.len() + 1);
    }

    #[test]
    fn parameters_have_four_digits_and_a_unit() {
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
