//! Normally distributed random numbers by the ziggurat algorithm with 256 layers (Marsaglia and Tsang, 2000). NumPy
//! draws the same numbers from the same stream, up to rounding.

use super::PhiloxStream;
use std::{array, sync::LazyLock};

const N_LAYERS: usize = 256;
/// Half the width of the ziggurat's lowest rectangle. The tail of the distribution begins here.
const EDGE: f64 = 3.654_152_885_361_009;
/// The area of the right half (x ≥ 0) of a layer, the same for all layers. In the lowest layer it includes the tail.
const AREA: f64 = 0.004_928_673_233_974_655;
/// The number of equal parts into which half the width of a layer is divided: a random 52-bit number selects one.
const N_FRACTIONS: f64 = (1u64 << 52) as f64;

/// A layer of the ziggurat. Layer 1 is at the top of the density curve, and layer 255 ends at [`EDGE`]. Layer 0 is the
/// lowest rectangle together with the tail.
#[derive(Debug, Clone, Copy)]
struct ZigguratLayer {
    /// The number of the layer's parts, counted from x = 0, that lie under the curve in the layer's whole height. A
    /// number drawn in them is accepted without a further test.
    inside: u64,
    /// The width of one of the [`N_FRACTIONS`] parts.
    width: f64,
    /// The value of the curve exp(-x²/2) at half the layer's width, where the lower edge of the layer meets the curve.
    /// Layer 0 has 1 instead, the height of the curve's top, which is the upper edge of layer 1.
    curve: f64,
}

/// The layers, equal to NumPy's tables up to rounding. They are computed by libm, which gives the same bytes on every
/// processor.
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
        // The fraction of the layer's width that the next higher layer covers. All points of this fraction are under
        // the curve.
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

/// A number drawn from the ziggurat, before the test whether it is accepted.
struct ZigguratDraw {
    x: f64,
    layer: usize,
    fraction: u64,
    /// Whether the number is accepted without a further test, in 99 of 100 cases.
    is_inside: bool,
}

impl ZigguratDraw {
    #[inline]
    fn new(layers: &[ZigguratLayer; N_LAYERS], bits: u64) -> Self {
        let (layer, fraction) = ((bits & 0xFF) as usize, (bits >> 9) & ((1 << 52) - 1));
        let ZigguratLayer { inside, width, .. } = layers[layer];
        let size = fraction as i64 as f64 * width;
        // The sign is set without a branch, since the processor would mispredict half of the branches.
        let x = f64::from_bits(size.to_bits() | ((bits & 0x100) << 55));
        Self { x, layer, fraction, is_inside: fraction < inside }
    }
}

impl PhiloxStream {
    /// Draws a standard normal number. NumPy's `standard_normal` draws the same number from the same stream, up to
    /// rounding.
    pub fn normal(&mut self) -> f64 {
        loop {
            let ZigguratDraw { x, layer, fraction, is_inside } = ZigguratDraw::new(&LAYERS, self.next_u64());
            if is_inside {
                return x;
            }
            if layer == 0 {
                let tail = self.tail();
                return if fraction & 0x100 == 0 { tail } else { -tail };
            }
            let (above, below) = (LAYERS[layer - 1].curve, LAYERS[layer].curve);
            if (above - below) * self.unit() + below < libm::exp(-0.5 * x * x) {
                return x;
            }
        }
    }

    /// Draws `N` ≤ 4 standard normal numbers, the same as `N` calls of [`normal`](Self::normal), but faster. Usually
    /// all come from one block of random bits, and are computed without a branch.
    #[inline]
    pub fn normals<const N: usize>(&mut self) -> [f64; N] {
        if let Some(block) = self.peek_block() {
            let layers = &*LAYERS;
            let draws: [ZigguratDraw; N] = array::from_fn(|i| ZigguratDraw::new(layers, block[i]));
            if draws.iter().all(|draw| draw.is_inside) {
                self.skip(N);
                return draws.map(|draw| draw.x);
            }
        }
        self.normals_one_by_one()
    }

    #[cold]
    fn normals_one_by_one<const N: usize>(&mut self) -> [f64; N] {
        array::from_fn(|_| self.normal())
    }

    /// Draws the absolute value of a normal number in the tail, beyond [`EDGE`] (Marsaglia, 1964).
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
