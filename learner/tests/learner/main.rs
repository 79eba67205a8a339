//! The tests of the learner in one program, so that libtorch is linked only once. They need the program
//! `perturb-server`: run `cargo build --release` first.

mod common;

mod epopt;
mod gradients;
mod learning;
mod losses;
mod presets;
mod recurrent;
mod rl2;
mod snapshots;
mod together;
