//! Functions that return the same bytes on every processor. The C library chooses instructions by processor, which
//! changes the rounding.

/// Returns eˣ.
pub fn exp(x: f32) -> f32 {
    libm::expf(x)
}

/// Returns the natural logarithm of `x`.
pub fn ln(x: f32) -> f32 {
    libm::logf(x)
}

/// Returns the logistic function 1/(1 + e⁻ˣ), with an absolute error below 2e-7.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    0.5 + 0.5 * tanh(0.5 * x)
}

/// Returns tanh x, with an absolute error below 3e-7. NaN stays NaN. It has neither branches nor calls, so over arrays
/// it is several times as fast as the C library's function.
///
/// tanh x = sign(x) (1 - e)/(1 + e) with e = exp(-2|x|) = 2^k 2^f, where k is an integer and |f| ≤ ½. 2^f is its Taylor
/// polynomial of degree 6, whose remainder is below (½ ln 2)⁷/7! = 1.2e-7.
#[inline(always)]
pub(crate) fn tanh(x: f32) -> f32 {
    /// Adding 1.5·2²³ rounds a number to an integer, which is then in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    /// Arguments are limited to ±9.1, where tanh differs from ±1 by less than 2⁻²⁵.
    const LARGEST: f32 = 9.1;
    /// The Taylor coefficients of 2^f: (ln 2)^i / i! for i = 6 … 0.
    const TAYLOR: [f32; 7] =
        [1.540_353e-4, 1.333_355_8e-3, 9.618_129e-3, 5.550_411e-2, 0.240_226_5, std::f32::consts::LN_2, 1.0];

    let magnitude = x.abs();
    let magnitude = if magnitude > LARGEST { LARGEST } else { magnitude }; // f32::min would turn NaN into a number
    let exponent = magnitude * (-2.0 * std::f32::consts::LOG2_E);
    let rounded = exponent + ROUND;
    let f = exponent - (rounded - ROUND);
    let mut power = TAYLOR[0];
    for coefficient in &TAYLOR[1..] {
        power = power * f + coefficient;
    }
    let k = rounded.to_bits().wrapping_sub(ROUND.to_bits());
    let e = power * f32::from_bits(k.wrapping_add(127) << 23);
    ((1.0 - e) / (1.0 + e)).copysign(x)
}

#[cfg(test)]
#[allow(clippy::disallowed_methods)] // the test compares with the standard library's functions
mod tests {
    use super::tanh;

    #[test]
    fn is_close_to_the_exact_one_everywhere() {
        let mut worst = 0.0f64;
        for i in -1_200_000..=1_200_000 {
            let x = i as f32 * 1e-5;
            worst = worst.max((f64::from(tanh(x)) - f64::from(x).tanh()).abs());
        }
        assert!(worst < 3e-7, "{worst}");
        for (x, expected) in [(f32::INFINITY, 1.0), (f32::NEG_INFINITY, -1.0), (1e30, 1.0), (0.0, 0.0)] {
            assert_eq!(tanh(x), expected);
        }
        assert!(tanh(f32::NAN).is_nan());
    }
}
