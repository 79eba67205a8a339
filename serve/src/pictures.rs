//! Finds pictures and films in the folders of runs.

use std::path::Path;

use perturb_files::{self as files, Stamp};

use crate::paths::RelativePath;

/// Maximum number of pictures of a run that its page shows.
const MAX_PICTURES: usize = 60;
/// Subfolders of a run that are not searched. They have no pictures, or other parts of the pages show their pictures.
const SKIPPED_FOLDERS: [&str; 5] = ["cells", "checkpoint", "marks", "report", "slurm"];
/// File name extensions of pictures and films.
const EXTENSIONS: [&str; 5] = ["svg", "png", "gif", "mp4", "webm"];

/// A picture or a film.
#[derive(Debug)]
pub(crate) struct RunPicture {
    pub(crate) relative: RelativePath,
    pub(crate) name: String,
    pub(crate) is_film: bool,
    /// Size and time of the file. It becomes part of the picture's address, so that browsers load a changed picture
    /// again.
    pub(crate) stamp: Stamp,
}

/// The pictures and films that a page shows.
#[derive(Debug, Default)]
pub(crate) struct Pictures {
    pub(crate) shown: Vec<RunPicture>,
    /// Number of further pictures, which are not shown because of the limit.
    pub(crate) more: usize,
}

impl Pictures {
    pub(crate) fn add(&mut self, others: Self) {
        self.shown.extend(others.shown);
        self.more += others.more;
    }
}

/// Finds the pictures in one folder, in the order of their names. Lists at most `max_shown` pictures, and only counts
/// the others. A picture that exists in two formats is listed once.
pub(crate) fn scan_folder(relative: &RelativePath, path: &Path, max_shown: usize) -> Pictures {
    let mut found = Pictures::default();
    let listed = files::list(path).unwrap_or_default(); // sorted
    let has = |file: &Path, extension: &str| listed.binary_search(&file.with_extension(extension)).is_ok();
    for file in &listed {
        let (Some(name), Some(extension)) =
            (file.file_name(), file.extension().and_then(|extension| extension.to_str()))
        else {
            continue;
        };
        let is_hidden = name.as_encoded_bytes().starts_with(b".");
        let is_second_format = extension == "png" && has(file, "svg") || extension == "gif" && has(file, "mp4");
        if is_hidden || is_second_format || !EXTENSIONS.contains(&extension) {
            continue;
        }
        if found.shown.len() == max_shown {
            found.more += 1;
        } else if let Some(stamp) = file.is_file().then(|| Stamp::read(file)).flatten() {
            let relative = relative.join(name);
            let name = name.to_string_lossy().into_owned();
            found.shown.push(RunPicture { relative, name, is_film: ["mp4", "webm"].contains(&extension), stamp });
        }
    }
    found
}

/// Finds the pictures of a run, in its folder and in the folders directly below it.
pub(crate) fn scan_run(relative: &RelativePath, path: &Path) -> Pictures {
    let mut found = scan_folder(relative, path, MAX_PICTURES);
    for folder in files::list(path).unwrap_or_default() {
        let Some(name) = folder.file_name().filter(|_| folder.is_dir() && !folder.is_symlink()) else { continue };
        let is_hidden = name.as_encoded_bytes().starts_with(b".");
        if !is_hidden && !SKIPPED_FOLDERS.iter().any(|skipped| name == *skipped) {
            let max_shown = MAX_PICTURES - found.shown.len();
            found.add(scan_folder(&relative.join(name), &folder, max_shown));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_beyond_the_limit_are_counted() {
        let directory = tempfile::tempdir().unwrap();
        for frame in 0..2_000 {
            std::fs::write(directory.path().join(format!("{frame:05}.png")), "").unwrap();
        }
        let found = scan_folder(&RelativePath::default(), directory.path(), 60);
        assert_eq!((found.shown.len(), found.more, found.shown[59].name.as_str()), (60, 1_940, "00059.png"));
        assert_eq!(scan_run(&RelativePath::default(), directory.path()).more, 1_940);
    }

    #[test]
    fn one_of_two_formats_is_shown_with_a_stamp_of_its_content() {
        let directory = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(directory.path().join(name), text).unwrap();
        for name in ["a.svg", "a.png", "b.png", "film.gif", "film.mp4", ".c.png", "d.txt"] {
            write(name, "x");
        }
        let names = || {
            let found = scan_folder(&RelativePath::default(), directory.path(), 60);
            found.shown.into_iter().map(|picture| picture.name).collect::<Vec<_>>()
        };
        assert_eq!(names(), ["a.svg", "b.png", "film.mp4"]);
        let stamps = || {
            let found = scan_run(&RelativePath::default(), directory.path());
            found.shown.iter().map(|picture| picture.stamp.tag()).collect::<Vec<_>>()
        };
        let before = stamps();
        write("b.png", "another");
        assert_ne!(stamps(), before);
    }
}
