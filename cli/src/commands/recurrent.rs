//! Becoming `perturb-recurrent`: this program with libtorch, which takes most of a second to load and which only the
//! gradients of recurrent policies need.

use std::ffi::OsStr;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use perturb_experiment::{Plan, VERSION};
use perturb_policy::has_recurrent;
use perturb_settings::Architecture;

use super::error::{CommandError, Result, system};

/// The name of the program that has libtorch, beside this one.
const PROGRAM: &str = "perturb-recurrent";
/// Tells that program which version it was started by.
const STARTED_BY: &str = "PERTURB_STARTED_BY";
/// How many threads OpenBLAS has, which reads it when it is loaded, before `main`.
const THREADS: &str = "OPENBLAS_NUM_THREADS";

/// Goes on as `perturb-recurrent` if the `architecture` is to be trained, from the beginning, with the same arguments and the
/// same process number. Comes back if that needs no libtorch, or if this is that program.
///
/// Makes sure that OpenBLAS computes on one thread: its threads cost more than they bring with networks this small, and
/// sums depend on their number. What the variable has already may stay, unless `one_thread` must be.
///
/// # Errors
/// The program is not there, or was not built together with this one.
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
    let threads = std::env::var_os(THREADS);
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

/// The same for all cells of a plan.
///
/// # Errors
/// Those of [`prepare`].
pub(super) fn prepare_for(plan: &Plan) -> Result<()> {
    let cells = || plan.cells.iter().chain(&plan.candidates);
    let any = cells().find(|cell| cell.config.common.architecture != Architecture::Ff);
    // An experiment's results must not depend on what a cluster's profile exports.
    prepare(any.map_or(Architecture::Ff, |cell| cell.config.common.architecture), true)
}

/// Makes a program that is started compute on one thread, whatever the variable is here.
pub(super) fn set_one_thread(command: &mut Command) {
    command.env(THREADS, "1");
}

/// The program `perturb`, which a job is to begin with: it becomes the other one where it must.
pub(super) fn usual_program() -> Result<PathBuf> {
    let program = current()?;
    Ok(if has_recurrent() { program.with_file_name("perturb") } else { program })
}

fn current() -> Result<PathBuf> {
    std::env::current_exe().map_err(system("find out where this program is"))
}
