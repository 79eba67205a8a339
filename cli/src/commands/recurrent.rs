//! Replaces this process with `perturb-recurrent`, which is the same program with libtorch.
//!
//! Only the gradients of recurrent policies need libtorch. `perturb-recurrent` is a separate program because libtorch
//! takes most of a second to load.

use std::ffi::OsStr;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use perturb_experiment::{Plan, VERSION};
use perturb_policy::has_recurrent;
use perturb_settings::Architecture;

use super::error::{CommandError, Result, system};

/// Name of the program with libtorch. It is in the same folder as `perturb`.
const PROGRAM: &str = "perturb-recurrent";
/// Environment variable in which `perturb` passes its version to `perturb-recurrent`.
const STARTED_BY: &str = "PERTURB_STARTED_BY";
/// Environment variable with the number of threads of OpenBLAS, which libtorch uses. OpenBLAS reads it before `main`.
const OPENBLAS_THREADS: &str = "OPENBLAS_NUM_THREADS";

/// Replaces this process with `perturb-recurrent` if training `architecture` needs libtorch. The new program has the
/// same arguments and process id. Returns if libtorch is not needed, or if this already is `perturb-recurrent` with the
/// right number of threads.
///
/// The new program runs OpenBLAS with one thread. More threads are slower for networks this small, and change the
/// results of sums. If the user has set another number of threads, it is kept unless `one_thread` is true. OpenBLAS
/// reads the number before `main`, so `perturb-recurrent` replaces itself to change the number.
///
/// # Errors
/// [`CommandError::Usage`] if `perturb-recurrent` cannot be started or has another version.
pub(super) fn prepare(architecture: Architecture, one_thread: bool) -> Result<()> {
    if architecture == Architecture::Ff {
        return Ok(());
    }
    if has_recurrent() {
        let started_by = std::env::var(STARTED_BY).unwrap_or_else(|_| VERSION.into());
        if started_by != VERSION {
            return Err(CommandError::Usage(format!(
                "perturb is {started_by}, but {PROGRAM} is {VERSION}: install both from one clone with `make \
                 install-recurrent`"
            )));
        }
    }
    let threads = std::env::var_os(OPENBLAS_THREADS);
    let threads_fit = threads.as_ref().is_some_and(|value| !one_thread || value == "1");
    if has_recurrent() && threads_fit {
        return Ok(());
    }
    let program = if has_recurrent() { current()? } else { current()?.with_file_name(PROGRAM) };
    let mut arguments = std::env::args_os();
    let name = arguments.next().unwrap_or_else(|| OsStr::new("perturb").to_owned());
    let mut command = Command::new(&program);
    command.arg0(name).args(arguments).env(STARTED_BY, VERSION);
    if !threads_fit {
        set_one_thread(&mut command);
    }
    let source = command.exec();
    let shown = program.display();
    Err(CommandError::Usage(format!(
        "recurrent policies are trained by the program {PROGRAM}, which cannot be started: {shown}: {source}. It needs \
         libtorch, so `make build`, `make install` and the Python wheel leave it out. In a clone of perturb, `make \
         recurrent` builds it with libtorch, and `make install-recurrent` installs it. Or train with --architecture ff"
    )))
}

/// Calls [`prepare`] if a cell of the plan trains a recurrent policy.
///
/// # Errors
/// See [`prepare`].
pub(super) fn prepare_for(plan: &Plan) -> Result<()> {
    let cells = || plan.cells.iter().chain(&plan.candidates);
    let recurrent = cells().find(|cell| cell.config.common.architecture != Architecture::Ff);
    // OpenBLAS must run with one thread. A cluster's shell profile may set another number in OPENBLAS_NUM_THREADS, and
    // the number of threads would change the results.
    prepare(recurrent.map_or(Architecture::Ff, |cell| cell.config.common.architecture), true)
}

/// Makes a command run OpenBLAS with one thread.
pub(super) fn set_one_thread(command: &mut Command) {
    command.env(OPENBLAS_THREADS, "1");
}

/// Tells whether [`prepare`] has started this process, or a process from which this one inherits its environment.
pub(super) fn is_replacement() -> bool {
    std::env::var_os(STARTED_BY).is_some()
}

/// Returns the path of `perturb`, which jobs run. It replaces itself with `perturb-recurrent` if necessary.
pub(super) fn perturb_program() -> Result<PathBuf> {
    let program = current()?;
    Ok(if has_recurrent() { program.with_file_name("perturb") } else { program })
}

fn current() -> Result<PathBuf> {
    std::env::current_exe().map_err(system("find the path of this program"))
}
