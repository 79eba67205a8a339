//! Pictures and films that lie in folders.

use std::path::Path;

use maud::{Markup, html};
use perturb_study::files::{self, Stamp};
use perturb_study::words::grouped;

use crate::paths::Relative;

/// Of a run at most so many are shown.
const MOST: usize = 60;
/// Folders of a run in which there is nothing to see, or what is shown elsewhere.
const WITHOUT: [&str; 5] = ["cells", "checkpoint", "marks", "report", "slurm"];
/// The endings of what is shown.
const FORMS: [&str; 5] = ["svg", "png", "gif", "mp4", "webm"];

/// A picture or a film.
#[derive(Debug)]
pub(crate) struct Picture {
    relative: Relative,
    name: String,
    film: bool,
    /// Of its content: a browser asks again for one that was drawn again.
    stamp: Stamp,
}

/// Pictures and films.
#[derive(Debug, Default)]
pub(crate) struct Pictures {
    pub(crate) shown: Vec<Picture>,
    /// How many there are beside these.
    pub(crate) more: usize,
}

impl Pictures {
    pub(crate) fn add(&mut self, others: Self) {
        self.shown.extend(others.shown);
        self.more += others.more;
    }
}

/// Those in the folder at `path`, in the order of their names, of which `most` are looked at. Of a picture in two forms
/// the first is shown.
pub(crate) fn in_folder(relative: &Relative, path: &Path, most: usize) -> Pictures {
    let mut found = Pictures::default();
    let listed = files::list(path).unwrap_or_default(); // sorted
    let has = |file: &Path, ending: &str| listed.binary_search(&file.with_extension(ending)).is_ok();
    for file in &listed {
        let (Some(name), Some(ending)) = (file.file_name(), file.extension().and_then(|ending| ending.to_str())) else {
            continue;
        };
        let hidden = name.as_encoded_bytes().starts_with(b".");
        let twice = ending == "png" && has(file, "svg") || ending == "gif" && has(file, "mp4");
        if hidden || twice || !FORMS.contains(&ending) {
            continue;
        }
        if found.shown.len() == most {
            found.more += 1;
        } else if let Some(stamp) = file.is_file().then(|| Stamp::of(file)).flatten() {
            let (relative, name) = (relative.join(name), name.to_string_lossy().into_owned());
            found.shown.push(Picture { relative, name, film: ["mp4", "webm"].contains(&ending), stamp });
        }
    }
    found
}

/// Those of a run: in its folder, and in folders in it.
pub(crate) fn of_run(relative: &Relative, path: &Path) -> Markup {
    let mut found = in_folder(relative, path, MOST);
    for inner in files::list(path).unwrap_or_default() {
        let Some(name) = inner.file_name().filter(|_| inner.is_dir() && !inner.is_symlink()) else { continue };
        let plain = !name.as_encoded_bytes().starts_with(b".") && !WITHOUT.iter().any(|without| name == *without);
        if plain {
            let room = MOST - found.shown.len();
            found.add(in_folder(&relative.join(name), &inner, room));
        }
    }
    shown(&found)
}

/// With a heading, if there are any.
pub(crate) fn shown(pictures: &Pictures) -> Markup {
    html! {
        @if !pictures.shown.is_empty() {
            h2 { "Pictures and films" }
            div.pictures { @for picture in &pictures.shown { (one(picture)) } }
        }
        @if pictures.more > 0 { p { "And " (grouped(pictures.more)) " more pictures and films." } }
    }
}

fn one(Picture { relative, name, film, stamp }: &Picture) -> Markup {
    let address = format!("/file/{}?v={}", relative.encode(), stamp.tag());
    html! {
        figure {
            @if *film {
                video src=(address) controls muted loop preload="metadata" aria-label={ "The film " (name) } {}
            } @else {
                a href=(address) { img src=(address) alt={ "The picture " (name) } loading="lazy"; }
            }
            figcaption { (relative.path().display()) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_thousands_of_pictures_some_are_shown() {
        let directory = tempfile::tempdir().unwrap();
        for frame in 0..2_000 {
            std::fs::write(directory.path().join(format!("{frame:05}.png")), "").unwrap();
        }
        let found = in_folder(&Relative::default(), directory.path(), 60);
        assert_eq!((found.shown.len(), found.more, found.shown[59].name.as_str()), (60, 1_940, "00059.png"));
        assert!(of_run(&Relative::default(), directory.path()).0.contains("And 1 940 more"));
    }

    #[test]
    fn of_two_forms_one_is_shown_at_an_address_of_its_content() {
        let directory = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(directory.path().join(name), text).unwrap();
        for name in ["a.svg", "a.png", "b.png", "film.gif", "film.mp4", ".c.png", "d.txt"] {
            write(name, "x");
        }
        let names = || {
            let found = in_folder(&Relative::default(), directory.path(), 60);
            found.shown.into_iter().map(|picture| picture.name).collect::<Vec<_>>()
        };
        assert_eq!(names(), ["a.svg", "b.png", "film.mp4"]);
        let before = of_run(&Relative::default(), directory.path()).0;
        write("b.png", "another");
        assert_ne!(of_run(&Relative::default(), directory.path()).0, before);
    }
}
