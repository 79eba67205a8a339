//! The library of the program `perturb`: its command line, and its videos of policies. Other packages do the work.
#![forbid(unsafe_code)]

pub mod commands;
pub mod video;
