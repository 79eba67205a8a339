//! Functions of the analytic tasks. Their dynamics are those of Gymnasium 1.4 in f64, with the crate libm's sine and
//! cosine: the C library's results differ in the last digits between processors.

use crate::env::{Action, Error, Stream};

/// Returns the choice of an action. The pool has already checked the action against the space.
pub(super) fn choice(action: Action<'_>) -> u32 {
    match action {
        Action::Discrete(choice) => choice,
        Action::Continuous(_) => unreachable!("a discrete environment is stepped with validated choices"),
    }
}

/// Adopts the state that the dynamics computed. If it is not finite as f32, the dynamics diverged, as extreme
/// parameters or states can cause, and the previous state is kept. Returns whether the dynamics diverged.
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

/// Loads a saved state of exactly `N` finite numbers, each within the limits of the dynamics.
pub(super) fn load<const N: usize>(state: &[f64], most: [f64; N]) -> Result<[f64; N], Error> {
    match <[f64; N]>::try_from(state) {
        Ok(state) if !observable(&state) => Err(Error::Snapshot { reason: "its state is not finite".into() }),
        Ok(state) if state.iter().zip(most).all(|(x, most)| x.abs() <= most) => Ok(state),
        Ok(_) => Err(Error::Snapshot { reason: format!("its state is not within ±{most:?}") }),
        Err(_) => Err(Error::Snapshot { reason: format!("its state has {} numbers, expected {N}", state.len()) }),
    }
}

/// Draws a state with every entry uniform in [low, high), in order.
pub(super) fn draw<const N: usize>(stream: &mut Stream, low: f64, high: f64) -> [f64; N] {
    std::array::from_fn(|_| stream.uniform(low, high))
}
