//! Testing: does a trained policy still work when the physics changes?

mod audit;
mod heatmap;
mod test;
mod trials;

use crate::checkpoint::Checkpoint;
pub use audit::{Audit, AuditError, audit};
pub use heatmap::{HeatmapError, heatmap, heatmap_again};
use perturb_policy::{Normalisers, Player, Result, Role};
pub use test::{TestError, TestOptions, Tester, check_unchanged, open_options, test};

/// The policy of a checkpoint as it plays in tests, with sampled actions and frozen statistics, in N = `n_envs` environments
/// whose indices are 0 … N-1. `seed` fixes the actions.
///
/// # Errors
/// Weights that do not fit.
pub fn player(checkpoint: &Checkpoint, n_envs: usize, seed: u64) -> Result<Player> {
    let Checkpoint { state, policy, weights } = checkpoint;
    let normalisers =
        Normalisers { observations: state.observation_normaliser.clone(), rewards: state.reward_normaliser.clone() };
    let episodes_per_trial = state.config.settings.episodes_per_trial();
    let role = Role::testing(seed, 0, n_envs);
    let mut player = Player::new(policy, state.inputs(n_envs), n_envs, episodes_per_trial, normalisers, role);
    if state.config.settings.is_random() {
        player = player.uniformly();
    }
    policy.check(weights)?;
    player.load(&weights.iter().flat_map(|array| array.data.iter().copied()).collect::<Vec<f32>>())?;
    Ok(player)
}
