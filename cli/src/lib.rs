//! The program `perturb`: its commands, and the videos that it makes. What they do is in the packages below.
#![forbid(unsafe_code)]

pub mod commands;
pub mod video;
