//! The program `perturb-recurrent`: `perturb` with libtorch. `perturb` executes this program to train recurrent
//! policies.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    perturb_torch::register();
    perturb_cli::commands::main()
}
