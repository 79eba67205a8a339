//! The sets of parameters that are typed.

use perturb_study::Version;
use perturb_study::files::read;
use perturb_study::sets::{Assignment, Contexts, TestSet, set_of, set_of_csv};

use super::args::SetArgs;
use super::error::{CommandError, Result};

/// What a set that is typed is called.
const NAME: &str = "parameters";

/// What to test on: `versions`, and the set that is typed; without either, all versions.
pub(super) fn tested(versions: &[Version], args: &SetArgs) -> Result<Vec<TestSet>> {
    let mut versions = versions.to_vec();
    versions.sort_unstable();
    versions.dedup();
    let mut sets: Vec<TestSet> = versions.into_iter().map(TestSet::from).collect();
    if !args.parameters.is_empty() {
        sets.push(set_of(NAME, args.base, args.parameters.clone())?);
    }
    if let Some(path) = &args.contexts {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        if name.parse::<Version>().is_ok() {
            let message = format!("{}: call the file otherwise, {name} is a version", path.display());
            return Err(CommandError::Usage(message));
        }
        sets.push(set_of_csv(&name, args.base, &read(path)?)?);
    }
    Ok(if sets.is_empty() { Version::ALL.map(TestSet::from).to_vec() } else { sets })
}

/// The set of `version` in which the parameters that are typed are drawn.
pub(super) fn drawn(version: Version, parameters: &[Assignment]) -> Result<TestSet> {
    if parameters.is_empty() {
        return Ok(version.into());
    }
    let set = set_of(NAME, version, parameters.to_vec())?;
    match set.contexts {
        Contexts::Drawn(_) => Ok(set),
        Contexts::Listed(_) => Err(CommandError::Usage(
            "--parameters has the points of a grid here; give values or intervals, as length=0.8..0.9".into(),
        )),
    }
}
