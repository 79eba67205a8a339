//! Divides the parameter space of a test into regions with about the same number of episodes.

use super::Outcomes;

/// Intended number of episodes in a region. Half of them, 20 episodes, estimate the region's success rate. The estimate
/// is then a multiple of 1/20.
const EPISODES: f64 = 40.0;

impl Outcomes {
    /// Returns the region of the parameter space to which each episode belongs, numbered from 0. If the test set is a
    /// list of contexts, each context is a region. Otherwise the range of each varying parameter is divided at
    /// quantiles of its own values. Every parameter is divided into the same number of intervals, chosen to give about
    /// 40 episodes in each region. The outcomes of the episodes have no influence on the division.
    pub fn parts(&self) -> Vec<usize> {
        if let Some(contexts) = &self.contexts {
            return contexts.clone();
        }
        let varies = |values: &&Vec<f64>| values.iter().any(|value| *value != values[0]);
        let varying: Vec<&Vec<f64>> = self.parameters.iter().filter(varies).collect();
        let episodes = self.returns.len();
        let intervals = (episodes as f64 / EPISODES).powf(1.0 / varying.len().max(1) as f64).round().max(1.0) as usize;
        let mut parts = vec![0; episodes];
        for values in varying {
            let mut sorted = values.clone();
            sorted.sort_unstable_by(f64::total_cmp);
            let cuts: Vec<f64> = (1..intervals).map(|cut| sorted[cut * episodes / intervals]).collect();
            for (part, value) in parts.iter_mut().zip(values) {
                *part = *part * intervals + cuts.partition_point(|cut| cut <= value);
            }
        }
        parts
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case(1000, 2, 25, 40)]
    #[case(1000, 3, 27, 37)]
    #[case(400, 1, 10, 40)]
    #[case(50, 3, 1, 50)]
    fn parts_hold_about_forty_episodes(
        #[case] n: usize,
        #[case] varying: usize,
        #[case] count: usize,
        #[case] least: usize,
    ) {
        // The parameters are different permutations of the same numbers. A fixed parameter of 0.75 does not divide the
        // space.
        let spread = |place: usize| (0..n).map(|i| ((i * [1, 7, 49][place]) % n) as f64).collect();
        let mut parameters: Vec<Vec<f64>> = (0..varying).map(spread).collect();
        parameters.push(vec![0.75; n]);
        let parts = Outcomes { parameters, returns: vec![0.0; n], ..Outcomes::default() }.parts();
        let sizes: Vec<usize> = (0..count).map(|part| parts.iter().filter(|&&is| is == part).count()).collect();
        assert_eq!(sizes.iter().sum::<usize>(), n);
        assert!(varying > 1 || sizes.iter().all(|size| *size >= least), "{sizes:?}");
    }

    #[test]
    fn equal_values_are_in_one_part_and_listed_contexts_are_parts() {
        let values: Vec<f64> = (0..400).map(|i| f64::from(i % 2)).collect();
        let outcomes = Outcomes { parameters: vec![values], returns: vec![0.0; 400], ..Outcomes::default() };
        let parts = outcomes.parts();
        assert!((0..400).all(|i| parts[i] == parts[i % 2]) && parts[0] != parts[1]);
        let contexts = Some((0..400).map(|i| i % 7).collect());
        assert_eq!(Outcomes { contexts, ..outcomes }.parts()[..9], [0, 1, 2, 3, 4, 5, 6, 0, 1]);
    }
}
