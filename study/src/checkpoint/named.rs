//! Policies by name: cells below `results/` whose trainings were kept.

use std::path::{Path, PathBuf};

use super::{CheckpointError, JSON, Result};
use crate::files::list;

/// Where they are, unless this variable says otherwise.
const FOLDER: &str = "results";
const VARIABLE: &str = "PERTURB_RESULTS";
/// Folders between it and `cells`, at most.
const DEPTH: usize = 3;

/// The checkpoint of the policy called `path`, if that is a name and no folder: a cell's id or its beginning, if no other
/// cell's begins so.
pub(super) fn find(path: &Path) -> Result<Option<PathBuf>> {
    let folder = std::env::var_os(VARIABLE).filter(|folder| !folder.is_empty());
    find_below(&folder.map_or_else(|| FOLDER.into(), PathBuf::from), path)
}

fn find_below(folder: &Path, path: &Path) -> Result<Option<PathBuf>> {
    let mut parts = path.components();
    let (Some(std::path::Component::Normal(name)), None) = (parts.next(), parts.next()) else { return Ok(None) };
    let Some(name) = name.to_str().filter(|_| !path.exists()) else { return Ok(None) };
    let mut found = Vec::new();
    collect(folder, name, DEPTH, &mut found);
    let id = |checkpoint: &PathBuf| checkpoint.ancestors().nth(2).and_then(Path::file_name).map(ToOwned::to_owned);
    let is_whole = |checkpoint: &&PathBuf| id(checkpoint).is_some_and(|id| id == name);
    if let [whole] = found.iter().filter(is_whole).collect::<Vec<_>>()[..] {
        return Ok(Some(whole.clone()));
    }
    match &found[..] {
        [] => Ok(None),
        [one] => Ok(Some(one.clone())),
        several => {
            let shown = |checkpoint: &PathBuf| match checkpoint
                .ancestors()
                .nth(2)
                .and_then(|cell| cell.strip_prefix(folder).ok())
            {
                Some(cell) => cell.display().to_string(),
                None => checkpoint.display().to_string(),
            };
            let names = several.iter().map(shown).collect();
            Err(CheckpointError::Several { name: name.to_owned(), folder: folder.to_owned(), names })
        }
    }
}

/// Adds the checkpoints of cells whose ids begin with `name`, in the order of their paths. What cannot be listed has none.
fn collect(folder: &Path, name: &str, depth: usize, found: &mut Vec<PathBuf>) {
    for path in list(folder).unwrap_or_default() {
        let Some(file) = path.file_name().and_then(|file| file.to_str()) else { continue };
        if file == "cells" {
            let begins = |cell: &PathBuf| cell.file_name().is_some_and(|id| id.to_string_lossy().starts_with(name));
            let checkpoints =
                list(&path).unwrap_or_default().into_iter().filter(begins).map(|cell| cell.join("training/checkpoint"));
            found.extend(checkpoints.filter(|checkpoint| checkpoint.join(JSON).is_file()));
        } else if depth > 0 && path.is_dir() {
            collect(&path, name, depth - 1, found);
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
        for none in ["Pendulum-D-1", "hopper", "a/cells/Hopper-R-1", "/Hopper-D", "..", ""] {
            assert_eq!(find(none).unwrap(), None, "{none}");
        }
        let several = find("Hopper").unwrap_err().to_string();
        assert!(several.contains("a/cells/Hopper-R-1, a/cells/Hopper-R-10, b/c/cells/Hopper-D-2"), "{several}");
        std::fs::create_dir_all(folder.path().join("d/cells/Hopper-D-2/training/checkpoint")).unwrap();
        std::fs::write(folder.path().join("d/cells/Hopper-D-2/training/checkpoint").join(JSON), "{}").unwrap();
        let twice = find("Hopper-D-2").unwrap_err().to_string();
        assert!(twice.contains("b/c/cells/Hopper-D-2, d/cells/Hopper-D-2"), "{twice}");
        std::fs::write(folder.path().join("cells/Acrobot-D-2"), "").unwrap();
        assert_eq!(find_below(&folder.path().join("cells/Acrobot-D-2"), Path::new("Acro")).unwrap(), None, "a file");
        assert_eq!(find_below(&folder.path().join("nowhere"), Path::new("Hopper-D")).unwrap(), None);
    }
}
