//! Hopper and HalfCheetah: Roboschool's task (Brockman et al., 2016; Schulman et al., 2017) on MuJoCo 2.2.2.
//!
//! [`Walker`] is the task that both share; [`HOPPER`] and [`HALF_CHEETAH`] say what differs. The models are in
//! `models/`, with the source of each number.

mod channels;
mod half_cheetah;
mod hopper;
mod model_edit;
mod walker;

pub use half_cheetah::{HALF_CHEETAH, half_cheetah};
pub use hopper::{HOPPER, hopper};
pub use walker::Walker;
