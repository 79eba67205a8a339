//! Tests of the program `perturb`. They are one program, so that libtorch is linked once, and need the program
//! `perturb-server`: run `cargo build --release` first.

mod common;

mod clocks;
mod compare;
mod end_to_end;
mod experiments;
mod guarded;
mod ledgers;
mod lines;
mod misuse;
mod odd_paths;
mod patience;
mod private;
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
