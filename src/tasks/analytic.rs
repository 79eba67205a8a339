//! Functions that the analytic tasks share. The dynamics of an analytic task are formulas, not a MuJoCo model. The
//! formulas are those of Gymnasium 1.4, computed in f64. Sine and cosine come from the crate libm, because the C
//! library's results differ in the last digits between processors.

use crate::env::{Action, Error, PhiloxStream};

/// Returns the index of the choice in an action. The caller must have checked that the action is a valid choice.
pub(super) fn choice(action: Action<'_>) -> u32 {
    match action {
        Action::Discrete(choice) => choice,
        Action::Continuous(_) => unreachable!("a discrete environment is stepped with validated choices"),
    }
}

/// Sets `state` to `next`, the result of the dynamics. If `next` is not finite as f32, the dynamics diverged: keeps the
/// previous state and returns true. Extreme parameters or states can cause a divergence.
pub(super) fn advance<const N: usize>(state: &mut [f64; N], next: [f64; N]) -> bool {
    let diverged = !observable(&next);
    if !diverged {
        *state = next;
    }
    diverged
}

fn observable(state: &[f64]) -> bool {
    state.iter().all(|&x| (x as f32).is_finite())
}

/// Checks a saved state and returns it. The state must have exactly `N` finite numbers. The absolute value of each
/// number must not exceed its limit in `most`.
pub(super) fn load<const N: usize>(state: &[f64], most: [f64; N]) -> Result<[f64; N], Error> {
    match <[f64; N]>::try_from(state) {
        Ok(state) if !observable(&state) => Err(Error::Snapshot { reason: "its state is not finite".into() }),
        Ok(state) if state.iter().zip(most).all(|(x, most)| x.abs() <= most) => Ok(state),
        Ok(_) => Err(Error::Snapshot { reason: format!("its state is not within ±{most:?}") }),
        Err(_) => Err(Error::Snapshot { reason: format!("its state has {} numbers, expected {N}", state.len()) }),
    }
}

/// Draws a state whose entries are independent and uniform in [low, high).
pub(super) fn draw<const N: usize>(stream: &mut PhiloxStream, low: f64, high: f64) -> [f64; N] {
    std::array::from_fn(|_| stream.uniform(low, high))
}
