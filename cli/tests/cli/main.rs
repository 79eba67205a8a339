//! Tests of the program `perturb`. All of them are in one test program, so that libtorch is linked only once. They need
//! the program `perturb-server`, so run `cargo build --release` first.

mod common;

mod clocks;
mod compare;
mod end_to_end;
mod experiments;
mod guarded;
mod hostile;
mod ledgers;
mod lines;
mod misuse;
mod odd_paths;
mod patience;
mod private;
mod processes;
mod processors;
mod programs;
mod resume;
mod serve;
mod servers;
mod sets;
mod showcases;
mod signals;
mod silence;
mod slurm;
mod tasks;
mod video;
