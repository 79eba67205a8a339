//! The learner's tests, one program, so that libtorch is linked once. They need the program `perturb-server`: run
//! `cargo build --release` first.

mod common;

mod epopt;
mod learning;
mod losses;
mod normaliser;
mod policy;
mod recurrent;
mod rl2;
