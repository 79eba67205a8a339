//! The tests of the bindings. They are one program, which is linked only once.
#![allow(clippy::unwrap_used)]

mod faults;
mod fields;
mod files;
mod kinematics;
mod pairs;
mod render;
mod states;
