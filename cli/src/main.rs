//! The program `perturb`.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    perturb_cli::commands::main()
}
