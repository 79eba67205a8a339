//! The program `perturb`.
#![forbid(unsafe_code)]

fn main() {}
