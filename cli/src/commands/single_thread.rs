//! One thread for linear algebra.

use std::ffi::OsStr;
use std::os::unix::process::CommandExt;
use std::process::Command;

const VARIABLE: &str = "OPENBLAS_NUM_THREADS";

/// Makes sure that OpenBLAS computes on one thread: its threads cost more than they bring with networks this small, and
/// sums depend on their number. OpenBLAS reads the variable when it is loaded, before `main`, so that the program has to
/// start again with the same process number. Returns if the variable has a value already, which must be 1 if `always`,
/// or if the start fails: then all works, but slower.
pub(super) fn ensure(always: bool) {
    if std::env::var_os(VARIABLE).is_some_and(|value| !always || value == "1") {
        return;
    }
    let Ok(program) = std::env::current_exe() else { return };
    let mut arguments = std::env::args_os();
    let name = arguments.next().unwrap_or_else(|| OsStr::new("perturb").to_owned());
    let error = Command::new(program).arg0(name).args(arguments).env(VARIABLE, "1").exec();
    tracing::warn!(%error, "cannot start again with {VARIABLE}=1");
}

/// Makes a program that is started compute on one thread, whatever the variable is here.
pub(super) fn set(command: &mut Command) {
    command.env(VARIABLE, "1");
}
