//! Normal numbers by the ziggurat (Marsaglia and Tsang, 2000) of 256 layers, as NumPy draws them from the same stream.

use super::Stream;
use std::{array, sync::LazyLock};

const N_LAYERS: usize = 256;
/// The half-width of the lowest rectangle. Beyond it is the tail.
const EDGE: f64 = 3.654_152_885_361_009;
/// The area of each layer: of each rectangle, and of the lowest one with the tail.
const AREA: f64 = 0.004_928_673_233_974_655;
/// The number of fractions that a layer is divided into.
const N_FRACTIONS: f64 = (1u64 << 52) as f64;

/// A layer of the ziggurat. Layer 1 is at the top of the curve, and layer 255 ends at [`EDGE`]. Layer 0 is the lowest
/// rectangle together with the tail.
#[derive(Debug, Clone, Copy)]
struct ZigguratLayer {
    /// Fractions below this are under the curve at every height of the layer.
    inside: u64,
    /// The half-width of a fraction.
    width: f64,
    /// The curve exp(-x²/2) at the half-width.
    curve: f64,
}

/// NumPy's tables, but for roundings: they are computed here by libm, whose bytes are the same on every processor.
static LAYERS: LazyLock<[ZigguratLayer; N_LAYERS]> = LazyLock::new(|| {
    let curve = |x: f64| libm::exp(-0.5 * x * x);
    let mut half_widths = [0.0; N_LAYERS];
    half_widths[0] = AREA / curve(EDGE);
    half_widths[N_LAYERS - 1] = EDGE;
    for layer in (1..N_LAYERS - 1).rev() {
        let below = half_widths[layer + 1];
        half_widths[layer] = libm::sqrt(-2.0 * libm::log(AREA / below + curve(below)));
    }
    array::from_fn(|layer| {
        let width = half_widths[layer];
        // The rectangle above covers this part of the layer.
        let covered = match layer {
            0 => EDGE / width,
            1 => 0.0,
            _ => half_widths[layer - 1] / width,
        };
        ZigguratLayer {
            inside: (covered * N_FRACTIONS) as u64,
            width: width / N_FRACTIONS,
            curve: if layer == 0 { 1.0 } else { curve(width) },
        }
    })
});

impl Stream {
    /// A standard normal number. NumPy's `standard_normal` gives the same of the same stream, up to rounding.
    pub fn normal(&mut self) -> f64 {
        loop {
            let bits = self.next_u64();
            let (number, fraction) = ((bits & 0xFF) as usize, (bits >> 9) & ((1 << 52) - 1));
            let layer = &LAYERS[number];
            let size = fraction as f64 * layer.width;
            // The sign is a bit, because a branch on it would be predicted wrongly half of the time.
            let x = f64::from_bits(size.to_bits() | ((bits & 0x100) << 55));
            if fraction < layer.inside {
                return x; // 99 of 100
            }
            if number == 0 {
                let tail = self.tail();
                return if fraction & 0x100 == 0 { tail } else { -tail };
            }
            let above = LAYERS[number - 1].curve;
            if (above - layer.curve) * self.unit() + layer.curve < libm::exp(-0.5 * x * x) {
                return x;
            }
        }
    }

    /// A normal number beyond the edge (Marsaglia, 1964).
    fn tail(&mut self) -> f64 {
        loop {
            let beyond = -libm::log1p(-self.unit()) / EDGE;
            let height = -libm::log1p(-self.unit());
            if 2.0 * height > beyond * beyond {
                return EDGE + beyond;
            }
        }
    }
}
