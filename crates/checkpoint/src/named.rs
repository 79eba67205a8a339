//! Finds policies by name. It searches policy files in folders called `policies` below `results/`, and the folders of
//! cells below `results/` whose trainings were kept. A cell is a training of an experiment with its tests.

use std::path::{Component, Path, PathBuf};

use perturb_files::{has_file, list, metadata_if_exists};
use perturb_protocol::names;

use super::single_file::{SUFFIX, is_policy};
use super::{CheckpointError, JSON, Result};

/// The folder that is searched, unless the environment variable [`VARIABLE`] is set.
const FOLDER: &str = "results";
const VARIABLE: &str = "PERTURB_RESULTS";
/// The name of folders with policy files.
const POLICIES: &str = "policies";
/// Maximal depth of folders called `cells` below the folder that is searched.
const DEPTH: usize = 3;
/// Maximum difference in length between a name and a suggested id, in characters.
const MAX_LENGTH_DIFFERENCE: usize = 3;

/// Finds the checkpoint that `path` refers to, if `path` is not a checkpoint itself. `path` may be a policy file or the
/// folder of a cell (a training with its tests), also relative to `results/`. It may also be the id of a cell, or the
/// unique beginning of an id. Upper and lower case are not distinguished.
///
/// # Errors
/// [`CheckpointError::Several`] with the cells whose ids begin with the name or, if there are none, whose ids resemble
/// it.
pub fn find(path: &Path) -> Result<Option<PathBuf>> {
    let folder = std::env::var_os(VARIABLE).filter(|folder| !folder.is_empty());
    let found = find_below(&folder.map_or_else(|| FOLDER.into(), PathBuf::from), path);
    if let Ok(Some(checkpoint)) = &found {
        tracing::debug!("the policy {} is that in {}", path.display(), checkpoint.display());
    }
    found
}

fn find_below(folder: &Path, path: &Path) -> Result<Option<PathBuf>> {
    let mut places = vec![path.to_owned(), path.join("training")];
    if metadata_if_exists(path)?.is_none() {
        let below = [Some(path), path.strip_prefix(FOLDER).ok()].into_iter().flatten().map(|rest| folder.join(rest));
        places.extend(below.flat_map(|place| [place.clone(), place.join("training")]));
    }
    for place in places {
        if holds_checkpoint(&place)? {
            return Ok((place != path).then_some(place));
        }
    }
    let mut parts = path.components();
    let (Some(Component::Normal(name)), None) = (parts.next(), parts.next()) else { return Ok(None) };
    let Some(name) = name.to_str().filter(|_| !path.exists()) else { return Ok(None) };
    let mut all = Vec::new();
    collect(folder, DEPTH, &mut all);
    let of = |is_meant: &dyn Fn(&str) -> bool| all.iter().filter(|kept| is_meant(&kept.id)).collect::<Vec<_>>();
    let begins = |id: &str| id.get(..name.len()).is_some_and(|start| start.eq_ignore_ascii_case(name));
    for found in [of(&|id| id == name), of(&|id| id.eq_ignore_ascii_case(name)), of(&begins)] {
        if let [one] = found[..] {
            return Ok(Some(one.checkpoint.clone()));
        }
    }
    let mut meant = of(&begins);
    if meant.is_empty() {
        let nearest = names::closest(name, all.iter().map(|kept| kept.id.as_str()));
        // A name that is not an id, such as the missing folder `hopper_run`, may resemble an id because their
        // beginnings are similar. A misspelled id also has about the same length as the id, so only such an id is
        // suggested.
        meant = of(&|id| nearest == Some(id) && id.len().abs_diff(name.len()) <= MAX_LENGTH_DIFFERENCE);
    }
    if meant.is_empty() {
        return Ok(None);
    }
    let shown = |kept: &&StoredPolicy| kept.cell.strip_prefix(folder).unwrap_or(&kept.cell).display().to_string();
    let names = meant.iter().map(shown).collect();
    Err(CheckpointError::Several { name: name.to_owned(), folder: folder.to_owned(), names })
}

/// Returns whether a checkpoint can be read from `path`.
fn holds_checkpoint(path: &Path) -> Result<bool> {
    Ok(is_policy(path)? || has_file(&path.join(JSON))? || has_file(&path.join("checkpoint").join(JSON))?)
}

/// A policy that the search found.
struct StoredPolicy {
    id: String,
    /// The folder of the cell that trained it, or the policy file.
    cell: PathBuf,
    checkpoint: PathBuf,
}

/// Adds all policies below `folder` to `found`, in the order of their paths. Skips folders that cannot be listed.
fn collect(folder: &Path, depth: usize, found: &mut Vec<StoredPolicy>) {
    let kept = |cell: PathBuf| {
        let id = cell.file_name()?.to_str()?.to_owned();
        let checkpoint = cell.join("training/checkpoint");
        checkpoint.join(JSON).is_file().then_some(StoredPolicy { id, cell, checkpoint })
    };
    let file = |path: PathBuf| {
        let is_policy = path.extension().is_some_and(|ending| ending == SUFFIX) && path.is_file();
        let id = path.file_stem()?.to_str()?.to_owned();
        is_policy.then(|| StoredPolicy { id, cell: path.clone(), checkpoint: path })
    };
    for path in list(folder).unwrap_or_default() {
        if path.ends_with(POLICIES) {
            found.extend(list(&path).unwrap_or_default().into_iter().filter_map(file));
        } else if path.ends_with("cells") {
            found.extend(list(&path).unwrap_or_default().into_iter().filter_map(kept));
        } else if depth > 0 && path.is_dir() {
            collect(&path, depth - 1, found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_a_cells_id_or_what_only_one_begins_with() {
        let folder = tempfile::tempdir().unwrap();
        for cell in ["a/cells/Hopper-R-1", "a/cells/Hopper-R-10", "b/c/cells/Hopper-D-2", "cells/Acrobot-D-1"] {
            std::fs::create_dir_all(folder.path().join(cell).join("training/checkpoint")).unwrap();
            std::fs::write(folder.path().join(cell).join("training/checkpoint").join(JSON), "{}").unwrap();
        }
        std::fs::create_dir_all(folder.path().join("a/cells/Pendulum-D-1/training")).unwrap();
        let find = |name: &str| find_below(folder.path(), Path::new(name));
        let place = |cell: &str| Some(folder.path().join(cell).join("training/checkpoint"));
        assert_eq!(find("Hopper-R-1").unwrap(), place("a/cells/Hopper-R-1"), "another begins with it");
        assert_eq!(find("Hopper-D").unwrap(), place("b/c/cells/Hopper-D-2"));
        assert_eq!(find("Acro").unwrap(), place("cells/Acrobot-D-1"));
        assert_eq!(find("hopper-r-10").unwrap(), place("a/cells/Hopper-R-10"), "in either case");
        assert_eq!(find("hopper-d").unwrap(), place("b/c/cells/Hopper-D-2"), "in either case");
        for none in ["Pendulum-D-1", "a/cells/Hopper-R-2", "/Hopper-D", "..", ""] {
            assert_eq!(find(none).unwrap(), None, "{none}");
        }
        let several = find("hopper").unwrap_err().to_string();
        assert!(several.contains("a/cells/Hopper-R-1, a/cells/Hopper-R-10, b/c/cells/Hopper-D-2"), "{several}");
        std::fs::create_dir_all(folder.path().join("d/cells/Hopper-D-2/training/checkpoint")).unwrap();
        std::fs::write(folder.path().join("d/cells/Hopper-D-2/training/checkpoint").join(JSON), "{}").unwrap();
        let twice = find("Hopper-D-2").unwrap_err().to_string();
        assert!(twice.contains("b/c/cells/Hopper-D-2, d/cells/Hopper-D-2"), "{twice}");
        std::fs::write(folder.path().join("cells/Acrobot-D-2"), "").unwrap();
        assert_eq!(find_below(&folder.path().join("cells/Acrobot-D-2"), Path::new("Acro")).unwrap(), None, "a file");
        assert_eq!(find_below(&folder.path().join("nowhere"), Path::new("Hopper-D")).unwrap(), None);
    }

    #[test]
    fn a_policy_file_is_found_by_its_name_and_path() {
        let folder = tempfile::tempdir().unwrap();
        let policies = folder.path().join(POLICIES);
        std::fs::create_dir_all(&policies).unwrap();
        for name in ["Hopper-R-1.safetensors", "Hopper-D-1.safetensors", "README.md"] {
            std::fs::write(policies.join(name), "").unwrap();
        }
        let find = |name: &Path| find_below(folder.path(), name).unwrap();
        let file = policies.join("Hopper-R-1.safetensors");
        for name in ["Hopper-R-1", "hopper-r", "policies/Hopper-R-1.safetensors"] {
            assert_eq!(find(Path::new(name)), Some(file.clone()), "{name}");
        }
        assert_eq!(find(&file), None, "it is the checkpoint itself");
        assert_eq!(find(Path::new("README")), None);
    }

    #[test]
    fn cell_folder_names_its_policy_with_any_prefix() {
        let folder = tempfile::tempdir().unwrap();
        let cell = "a/cells/Hopper-R-1";
        let training = folder.path().join(cell).join("training");
        std::fs::create_dir_all(training.join("checkpoint")).unwrap();
        std::fs::write(training.join("checkpoint").join(JSON), "{}").unwrap();
        let find = |path: &Path| find_below(folder.path(), path).unwrap();
        for written in [folder.path().join(cell), cell.into(), Path::new(FOLDER).join(cell)] {
            assert_eq!(find(&written), Some(training.clone()), "{}", written.display());
        }
        assert_eq!(find(&Path::new(cell).join("training")), Some(training.clone()));
        assert_eq!(find(&training), None, "it is where the checkpoint is looked for anyway");
    }

    #[test]
    fn near_name_is_refused_with_a_suggestion() {
        let folder = tempfile::tempdir().unwrap();
        for cell in ["CartPole-ppo-ff-D-9bd6546b-s7", "CartPole-ppo-ff-E-9bd6546b-s7"] {
            std::fs::create_dir_all(folder.path().join("a/cells").join(cell).join("training/checkpoint")).unwrap();
            let json = folder.path().join("a/cells").join(cell).join("training/checkpoint").join(JSON);
            std::fs::write(json, "{}").unwrap();
        }
        let find = |name: &str| find_below(folder.path(), Path::new(name));
        let near = find("CartPole-ppo-ff-D-9bd6546b-s77").unwrap_err().to_string();
        assert!(near.ends_with("the path of one: a/cells/CartPole-ppo-ff-D-9bd6546b-s7"), "{near}");
        for none in ["missing", "cart_pole", "CartPole-ppo-rc"] {
            assert_eq!(find(none).unwrap(), None, "{none}");
        }
    }
}
