//! The program `perturb-recurrent`: `perturb` with libtorch, which `perturb` becomes where a recurrent policy is trained.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    perturb_torch::register();
    perturb_cli::commands::main()
}
