//! The colour palette of a GIF. All frames share it, so that unchanged pixels keep their colour.

use std::cmp::Reverse;
use std::collections::HashMap;

/// The palette index that marks a pixel as unchanged since the last frame. It is 0 and not 255, because a frame's
/// largest index determines the minimum size of its LZW codes.
pub(super) const UNCHANGED: u8 = 0;
/// Maximum number of colours. A GIF has 256 indices, and one is [`UNCHANGED`].
const MAX_COLOURS: usize = 255;
/// Maximum number of colours that are chosen from the first frame. The rest of the palette is for colours of later
/// frames.
const FIRST_FRAME_COLOURS: usize = 128;
/// Minimum distance between a new colour of a later frame and all colours of the palette. Distances are Euclidean, with
/// red, green and blue from 0 to 255. The minimum grows as the palette fills up.
const MIN_NEW_DISTANCE: u32 = 16;

type PixelColour = [u8; 3];

/// A palette of up to 255 colours. When a colour occurs for the first time, it is mapped to the nearest colour of the
/// palette. If that is too far away and the palette has room, the colour is added instead. The mapping then never
/// changes.
pub(super) struct Palette {
    colours: Vec<PixelColour>,
    /// The palette index of each of the 2²⁴ colours, at the position red · 2¹⁶ + green · 2⁸ + blue; 0 for a colour that
    /// was not looked up yet. Most entries are never written, so the operating system gives them no memory.
    index_of_colour: Vec<u8>,
}

impl Palette {
    /// Makes a palette from the first frame, `[height, width, 3]`. It has all colours of the frame if they are few
    /// enough, and otherwise a selection. The selection is finer near colours of many pixels, such as the sky.
    pub(super) fn learn(frame: &[u8]) -> Self {
        let mut counts = HashMap::new();
        for colour in frame.as_chunks().0 {
            *counts.entry(*colour).or_insert(0_u32) += 1;
        }
        let mut all: Vec<(PixelColour, u32)> = counts.into_iter().collect();
        all.sort_unstable_by_key(|&(colour, count)| (Reverse(count), colour));
        let colours = (1..).find_map(|apart| select_colours(&all, apart)).unwrap_or_default();
        Self { colours, index_of_colour: vec![UNCHANGED; 1 << 24] }
    }

    /// Returns the red, green and blue value of each palette index.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let unchanged = [0; 3];
        std::iter::once(&unchanged).chain(&self.colours).flatten().copied().collect()
    }

    /// Writes the palette index of each pixel of a frame, `[height, width, 3]`, to `indices`.
    pub(super) fn indices(&mut self, frame: &[u8], indices: &mut Vec<u8>) {
        indices.clear();
        indices.extend(frame.as_chunks().0.iter().map(|&colour| {
            let [red, green, blue] = colour.map(usize::from);
            let place = red << 16 | green << 8 | blue;
            if self.index_of_colour[place] == UNCHANGED {
                self.index_of_colour[place] = self.index(colour);
            }
            self.index_of_colour[place]
        }));
    }

    fn index(&mut self, colour: PixelColour) -> u8 {
        let later = self.colours.len().saturating_sub(FIRST_FRAME_COLOURS) as u32;
        let new = MIN_NEW_DISTANCE.max(later / 2).pow(2);
        let distances = self.colours.iter().map(|&known| distance(known, colour));
        let nearest = distances.enumerate().min_by_key(|&(_, distance)| distance);
        let place = match nearest {
            Some((place, distance)) if distance < new || self.colours.len() == MAX_COLOURS => place,
            _ => {
                self.colours.push(colour);
                self.colours.len() - 1
            }
        };
        place as u8 + 1
    }
}

/// Selects colours from `all`, pairs of a colour and its number of pixels. A colour with one pixel is selected if its
/// distance from all selected colours is at least `apart`. The required distance shrinks with the fourth root of the
/// number of pixels, so it is half as large for 16 pixels. Returns `None` if more than [`FIRST_FRAME_COLOURS`] are
/// selected.
fn select_colours(all: &[(PixelColour, u32)], apart: u64) -> Option<Vec<PixelColour>> {
    let mut colours: Vec<PixelColour> = Vec::new();
    for &(colour, count) in all {
        let is_far =
            |&other: &PixelColour| u64::from(distance(colour, other)).pow(2) * u64::from(count) >= apart.pow(4);
        if colours.iter().all(is_far) {
            if colours.len() == FIRST_FRAME_COLOURS {
                return None;
            }
            colours.push(colour);
        }
    }
    Some(colours)
}

/// Returns the squared Euclidean distance between two colours.
fn distance(a: PixelColour, b: PixelColour) -> u32 {
    a.iter().zip(b).map(|(&a, b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the shown colours of a frame.
    fn shown(palette: &mut Palette, frame: &[u8]) -> Vec<u8> {
        let mut indices = Vec::new();
        palette.indices(frame, &mut indices);
        let bytes = palette.bytes();
        indices.iter().flat_map(|&index| bytes[3 * usize::from(index)..][..3].to_vec()).collect()
    }

    #[test]
    fn few_colours_are_all_kept() {
        let frame: Vec<u8> = (0..FIRST_FRAME_COLOURS as u8).flat_map(|level| [level, 255 - level, 7]).collect();
        let mut palette = Palette::learn(&frame);
        assert_eq!(shown(&mut palette, &frame), frame);
        let later = [[0, 158, 115], [213, 94, 0], [255, 255, 255]].concat();
        assert_eq!(shown(&mut palette, &later), later, "what comes later has room");
        assert_eq!(shown(&mut palette, &frame), frame, "and changes nothing");
    }

    #[test]
    fn every_colour_is_near_a_colour_of_the_palette() {
        let frame: Vec<u8> = (0..64 * 64).flat_map(|n| [n % 64 * 4, n / 64 * 4, 90].map(|value| value as u8)).collect();
        let mut palette = Palette::learn(&frame);
        let seen = shown(&mut palette, &frame);
        let far = |a: &[u8], b: &[u8]| distance([a[0], a[1], a[2]], [b[0], b[1], b[2]]);
        let worst = frame.chunks(3).zip(seen.chunks(3)).map(|(a, b)| far(a, b)).max().unwrap();
        assert!(worst <= 32 * 32, "{worst}"); // 128 colours on a square of 255 are 23 apart
        for later in (0..=u8::MAX).flat_map(|red| (0..=u8::MAX).step_by(5).map(move |green| [red, green, red ^ green]))
        {
            shown(&mut palette, &later);
        }
        let badge = [255, 255, 0];
        assert!(distance(shown(&mut palette, &badge)[..].try_into().unwrap(), badge) <= 64 * 64);
        assert!(palette.bytes().len() <= 3 * 256);
    }
}
