//! `perturb completions` and `perturb man`: shell completions and manual pages.

use std::io::Write;

use perturb_text::quoted;

use super::args::{Cli, CompletionsArgs, ManArgs};
use super::display::note;
use super::error::{CommandError, Result, system};

pub(super) fn completions(args: &CompletionsArgs) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Cli::parser(), "perturb", &mut script);
    Ok(std::io::stdout().write_all(&script)?)
}

pub(super) fn man(args: &ManArgs) -> Result<()> {
    if !args.dir.is_dir() {
        let folder = args.dir.display();
        let command = format!("mkdir -p {}", quoted(&args.dir));
        return Err(CommandError::Usage(format!("there is no folder {folder}; make it with `{command}`")));
    }
    clap_mangen::generate_to(Cli::parser(), &args.dir).map_err(system("write the manual pages"))?;
    note(format_args!("the manual pages are in {}", args.dir.display()));
    Ok(())
}
