//! The colours of a GIF: one palette for all its frames, so that what stays as it is keeps its colour.

use std::cmp::Reverse;
use std::collections::HashMap;

/// What stands for "as it was": of all indices the first, so that few colours take few bits.
pub(super) const UNCHANGED: u8 = 0;
/// A GIF's, of which one is no colour.
const MOST: usize = 255;
/// So many colours are learned from the first frame; the other places are for what comes later.
const LEARNED: usize = 128;
/// A later colour takes one of them if it is at least so far from all, of 255 steps of red, green or blue: farther and
/// farther when there are few left.
const NEW: u32 = 16;

type Colour = [u8; 3];

/// Up to 255 colours, and which of them is nearest to each of all.
pub(super) struct Palette {
    colours: Vec<Colour>,
    /// Index of each colour that was met, by its 24 bits, else 0. The zeros take no memory before they are written.
    met: Vec<u8>,
}

impl Palette {
    /// Of a frame `[height, width, 3]`: all its colours if there are few, else some that are near all of them, and
    /// nearer to those of many pixels, such as a sky.
    pub(super) fn learn(frame: &[u8]) -> Self {
        let mut counts = HashMap::new();
        for colour in frame.as_chunks().0 {
            *counts.entry(*colour).or_insert(0_u32) += 1;
        }
        let mut all: Vec<(Colour, u32)> = counts.into_iter().collect();
        all.sort_unstable_by_key(|&(colour, count)| (Reverse(count), colour));
        let colours = (1..).find_map(|apart| spread(&all, apart)).unwrap_or_default();
        Self { colours, met: vec![UNCHANGED; 1 << 24] }
    }

    /// Red, green and blue of each index.
    pub(super) fn bytes(&self) -> Vec<u8> {
        let unchanged = [0; 3];
        std::iter::once(&unchanged).chain(&self.colours).flatten().copied().collect()
    }

    /// Writes the index of each pixel of a frame `[height, width, 3]`.
    pub(super) fn indices(&mut self, frame: &[u8], indices: &mut Vec<u8>) {
        indices.clear();
        indices.extend(frame.as_chunks().0.iter().map(|&colour| {
            let [red, green, blue] = colour.map(usize::from);
            let place = red << 16 | green << 8 | blue;
            if self.met[place] == UNCHANGED {
                self.met[place] = self.index(colour);
            }
            self.met[place]
        }));
    }

    fn index(&mut self, colour: Colour) -> u8 {
        let later = self.colours.len().saturating_sub(LEARNED) as u32;
        let new = NEW.max(later / 2).pow(2);
        let distances = self.colours.iter().map(|&known| distance(known, colour));
        let nearest = distances.enumerate().min_by_key(|&(_, distance)| distance);
        let place = match nearest {
            Some((place, distance)) if distance < new || self.colours.len() == MOST => place,
            _ => {
                self.colours.push(colour);
                self.colours.len() - 1
            }
        };
        place as u8 + 1
    }
}

/// Colours that are at least so far `apart`, those of 16 pixels half as far; `None` if they are too many.
fn spread(all: &[(Colour, u32)], apart: u64) -> Option<Vec<Colour>> {
    let mut colours: Vec<Colour> = Vec::new();
    for &(colour, count) in all {
        let is_far = |&other: &Colour| u64::from(distance(colour, other)).pow(2) * u64::from(count) >= apart.pow(4);
        if colours.iter().all(is_far) {
            if colours.len() == LEARNED {
                return None;
            }
            colours.push(colour);
        }
    }
    Some(colours)
}

/// The square of the distance.
fn distance(a: Colour, b: Colour) -> u32 {
    a.iter().zip(b).map(|(&a, b)| u32::from(a.abs_diff(b)).pow(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is shown of a frame.
    fn shown(palette: &mut Palette, frame: &[u8]) -> Vec<u8> {
        let mut indices = Vec::new();
        palette.indices(frame, &mut indices);
        let bytes = palette.bytes();
        indices.iter().flat_map(|&index| bytes[3 * usize::from(index)..][..3].to_vec()).collect()
    }

    #[test]
    fn few_colours_are_all_kept() {
        let frame: Vec<u8> = (0..LEARNED as u8).flat_map(|level| [level, 255 - level, 7]).collect();
        let mut palette = Palette::learn(&frame);
        assert_eq!(shown(&mut palette, &frame), frame);
        let later = [[0, 158, 115], [213, 94, 0], [255, 255, 255]].concat();
        assert_eq!(shown(&mut palette, &later), later, "what comes later has room");
        assert_eq!(shown(&mut palette, &frame), frame, "and changes nothing");
    }

    #[test]
    fn of_many_colours_none_is_far_from_what_is_shown() {
        let frame: Vec<u8> = (0..64 * 64).flat_map(|n| [n % 64 * 4, n / 64 * 4, 90].map(|value| value as u8)).collect();
        let mut palette = Palette::learn(&frame);
        let seen = shown(&mut palette, &frame);
        let far = |a: &[u8], b: &[u8]| distance([a[0], a[1], a[2]], [b[0], b[1], b[2]]);
        let worst = frame.chunks(3).zip(seen.chunks(3)).map(|(a, b)| far(a, b)).max().unwrap();
        assert!(worst <= 32 * 32, "{worst}"); // 128 places on a square of 255 are 23 apart
        for later in (0..=u8::MAX).flat_map(|red| (0..=u8::MAX).step_by(5).map(move |green| [red, green, red ^ green]))
        {
            shown(&mut palette, &later);
        }
        let badge = [255, 255, 0];
        assert!(distance(shown(&mut palette, &badge)[..].try_into().unwrap(), badge) <= 64 * 64);
        assert!(palette.bytes().len() <= 3 * 256);
    }
}
