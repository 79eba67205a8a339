//! Significance tests for paired comparisons, where a pair is the results of two methods in the same environment with
//! the same seed.

use perturb_policy::random::{Purpose, stream};
use rand::Rng;

/// Maximum number of pairs for which the p-value is exact: all 2ⁿ combinations of signs are counted.
const MAX_EXACT_PAIRS: usize = 16;
/// Number of random combinations of signs that are counted if there are more than [`MAX_EXACT_PAIRS`] pairs.
const N_SIGN_SAMPLES: u32 = 100_000;

/// Returns the p-value of Fisher's two-sided randomisation test for paired differences (The Design of Experiments,
/// 1935). It is the probability that the sum of the differences is at least as far from 0 as observed, if each
/// difference gets a random sign.
///
/// Pairs with a difference of 0 are ignored. With up to 16 remaining pairs, all combinations of signs are counted. With
/// more, the observed combination and 100 000 random ones are counted, as in Phipson and Smyth (2010). Returns 1 if no
/// pair differs. The smallest possible value with n ≤ 16 pairs is 2¹⁻ⁿ.
pub fn sign_flip_p(differences: &[f64], seed: u64) -> f64 {
    let differences: Vec<f64> = differences.iter().copied().filter(|difference| *difference != 0.0).collect();
    let seen: f64 = differences.iter().sum::<f64>().abs();
    // Tolerance for comparing sums, because sums that are equal in theory may differ by rounding errors.
    let rounding = 1e-9 * differences.iter().map(|difference| difference.abs()).sum::<f64>();
    // `next_signs` returns the signs of the next 64 differences, one in each bit.
    let is_as_far = |next_signs: &mut dyn FnMut() -> u64| {
        let signed = |differences: &[f64]| -> f64 {
            let signs = next_signs();
            let sign = |place: usize| if signs >> place & 1 == 1 { 1.0 } else { -1.0 };
            differences.iter().enumerate().map(|(place, difference)| sign(place) * difference).sum()
        };
        let sum: f64 = differences.chunks(64).map(signed).sum();
        sum.abs() >= seen - rounding
    };
    if differences.len() <= MAX_EXACT_PAIRS {
        let all = 1_u64 << differences.len();
        return (0..all).filter(|&signs| is_as_far(&mut || signs)).count() as f64 / all as f64;
    }
    let mut rng = stream(seed, Purpose::Bootstrap);
    let as_far = (0..N_SIGN_SAMPLES).filter(|_| is_as_far(&mut || rng.next_u64())).count();
    (1 + as_far) as f64 / f64::from(1 + N_SIGN_SAMPLES)
}

/// Returns the p-values of several comparisons after Holm's correction (1979), in the given order. If every comparison
/// with a corrected value up to α is called significant, the probability of any false one is at most α, however the
/// comparisons depend on each other.
pub fn holm(p: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|&a, &b| p[a].total_cmp(&p[b]));
    let (mut corrected, mut least) = (vec![0.0; p.len()], 0.0_f64);
    for (rank, &place) in order.iter().enumerate() {
        least = least.max(p[place] * (p.len() - rank) as f64).min(1.0);
        corrected[place] = least;
    }
    corrected
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chance_of_a_sum_is_counted_over_all_signs() {
        assert_eq!(sign_flip_p(&[1.0, 2.0, 3.0], 1), 0.25, "only +++ and --- come to 6");
        assert_eq!(sign_flip_p(&[-1.0, -2.0, -3.0], 1), 0.25, "either side counts");
        assert_eq!(sign_flip_p(&[3.0, -1.0], 1), 1.0, "±2 and ±4");
        assert_eq!(sign_flip_p(&[1.0, 2.0, 3.0, 0.0], 1), 0.25, "a tie says nothing");
        assert_eq!(sign_flip_p(&[0.1, 0.1, 0.1, -0.1], 1), 0.625, "±0.2 and ±0.4, though sums of 0.1 are rounded");
        assert_eq!((sign_flip_p(&[], 1), sign_flip_p(&[0.0], 1)), (1.0, 1.0));
        assert_eq!(sign_flip_p(&[1.0; 16], 1), 2_f64.powi(-15));
    }

    #[test]
    fn pairs_64_apart_have_independent_signs() {
        let signed = |positive: usize, size: f64| (0..64).map(move |i| if i < positive { size } else { -size });
        let differences: Vec<f64> = signed(36, 1.0).chain(signed(40, 0.5)).collect();
        // The sum is 16. The exact p is 0.083. If pairs 64 apart had the same sign, it would be 0.18.
        let p = sign_flip_p(&differences, 1);
        assert!((0.06..0.09).contains(&p), "{p}");
    }

    /// With 17 pairs there are 131 072 combinations of signs. The p-value is estimated from the observed combination
    /// and 100 000 random ones. The estimate's standard deviation is √(p (1 - p) / 100 000), at most 0.0016.
    #[test]
    fn p_of_many_pairs_is_estimated_from_random_signs() {
        let differences: Vec<f64> = (0..17).map(|i| f64::from(i % 5) - 1.2).collect();
        let with_one_more = |sign: f64| sign_flip_p(&[&differences[..16], &[sign * differences[16]]].concat(), 1);
        // The absolute sum of the differences if difference i has the sign in bit i of `signs`.
        let sum = |signs: u32| {
            let sign = |i: usize| if signs >> i & 1 == 1 { 1.0 } else { -1.0 };
            (0..17).map(|i| sign(i) * differences[i]).sum::<f64>().abs()
        };
        // The exact p-value: the share of combinations whose sum is at least as large as with all signs positive.
        let seen = sum((1 << 17) - 1) - 1e-9;
        let exact = (0..1 << 17).filter(|&signs| sum(signs) >= seen).count() as f64 / f64::from(1 << 17);
        assert!((with_one_more(1.0) - exact).abs() < 0.008 && exact > 0.01 && exact < 0.9, "{exact}");
        assert_eq!(with_one_more(1.0), sign_flip_p(&differences, 1), "the same seed");
        assert!(sign_flip_p(&[1.0; 40], 1) < 2e-5 && sign_flip_p(&[1.0; 40], 1) > 0.0, "never 0");
    }

    #[test]
    fn the_smallest_of_many_counts_most() {
        let corrected = holm(&[0.01, 0.04, 0.03, 0.005]);
        // The sorted p-values are multiplied by 4, 3, 2 and 1: 0.02, 0.03, 0.06 and 0.04. Holm raises the last product
        // to the one before it, 0.06.
        let expected = [0.03, 0.06, 0.06, 0.02];
        assert!(corrected.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-15), "{corrected:?}");
        assert_eq!(holm(&[0.6, 0.9]), [1.0, 1.0]);
        assert!(holm(&[]).is_empty());
    }
}
