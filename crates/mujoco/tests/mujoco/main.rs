//! The tests of the bindings, one program, so that it is linked once.
#![allow(clippy::unwrap_used)]

mod faults;
mod fields;
mod files;
mod kinematics;
mod pairs;
mod render;
mod states;
