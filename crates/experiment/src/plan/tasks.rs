//! Resolves the task folders that an experiment file names.

use std::path::{Path, PathBuf};

use perturb_settings::{ValueError, require};
use toml::{Spanned, Value};

/// Key of the experiment file that lists task folders.
const KEY: &str = "tasks";

/// Replaces the task folders in `text`, the content of an experiment file, by absolute paths. Returns the new text and
/// the paths. `written` are the folders as written in the file, relative to `folder`. Copies of the new text in other
/// folders name the same tasks.
///
/// # Errors
/// [`ValueError`] for a folder that is listed twice, or whose path is empty or not UTF-8.
pub(super) fn resolve(
    mut text: String,
    written: &[Spanned<String>],
    folder: &Path,
) -> Result<(String, Vec<PathBuf>), ValueError> {
    let expected = "a folder with a file task.toml";
    let absolute = |name: &str| {
        require(!name.is_empty(), KEY, "an empty name", expected)?;
        let path = std::path::absolute(folder.join(name))
            .map_err(|error| ValueError::new(KEY, format!("`{name}` ({error})"), expected))?;
        // Resolves `.`, `..` and links if the folder exists. Otherwise the absolute path stays as written.
        Ok(path.canonicalize().unwrap_or(path))
    };
    let tasks = written.iter().map(|name| absolute(name.get_ref())).collect::<Result<Vec<_>, _>>()?;
    for (place, task) in tasks.iter().enumerate() {
        let got = format!("`{}` twice", task.display());
        require(!tasks[..place].contains(task), KEY, got, "a list without repetitions")?;
    }
    // Replaces from the end, so that the positions of earlier paths stay valid.
    for (name, task) in written.iter().zip(&tasks).rev() {
        let path = task.to_str().ok_or_else(|| ValueError::new(KEY, format!("{task:?}"), "a path in UTF-8"))?;
        text.replace_range(name.span(), &Value::from(path).to_string());
    }
    Ok((text, tasks))
}

#[cfg(test)]
mod tests {
    use crate::plan::Plan;

    /// Returns the text of a plan with these tasks.
    fn plan(tasks: &str) -> String {
        format!(
            "tasks = {tasks} # two\nenvironments = ['Walker', 'Arm']\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']"
        )
    }

    #[test]
    fn a_copy_of_a_plan_names_the_same_task_folders() {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().canonicalize().unwrap();
        std::fs::create_dir_all(place.join("plans")).unwrap();
        std::fs::create_dir(place.join("it's")).unwrap();
        let path = place.join("plans/plan.toml").display().to_string();
        let first = Plan::parse(&path, plan("[\"../it's\", 'arm']")).unwrap();
        assert_eq!(first.tasks, [place.join("it's"), place.join("plans/arm")]);
        let copy = Plan::parse("elsewhere/plan.toml", first.text.clone()).unwrap();
        assert_eq!((&copy.tasks, &copy.text), (&first.tasks, &first.text));
        assert!(copy.text.contains("] # two\n"), "{}", copy.text);
        assert!(Plan::parse("plan.toml", plan("[]")).unwrap().tasks.is_empty());
    }

    #[test]
    fn task_folders_are_named_once() {
        let refused = |tasks: &str| Plan::parse("/p/plan.toml", plan(tasks)).unwrap_err().to_string();
        let twice = refused("['a', '/p/a']");
        assert_eq!(twice, "/p/plan.toml: tasks is `/p/a` twice, but must be a list without repetitions");
        assert!(refused("['']").contains("a folder with a file task.toml"));
    }
}
