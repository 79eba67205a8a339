//! Pictures and films that lie in folders.

use std::path::Path;

use maud::{Markup, html};
use perturb_study::files;

use crate::paths::Relative;

/// Of a run at most so many are shown.
const MOST: usize = 60;
/// Folders of a run in which there is nothing to see, or what is shown elsewhere.
const WITHOUT: [&str; 5] = ["cells", "checkpoint", "marks", "report", "slurm"];

/// A picture or a film.
#[derive(Debug)]
pub(crate) struct Picture {
    relative: Relative,
    name: String,
    film: bool,
}

/// Those in the folder at `path`, in the order of their names. Of a picture in two forms the first is shown.
pub(crate) fn in_folder(relative: &Relative, path: &Path) -> Vec<Picture> {
    let mut found: Vec<Picture> = Vec::new();
    let forms = ["svg", "png", "gif", "mp4", "webm"];
    let listed = files::list(path).unwrap_or_default();
    let has = |file: &Path, ending: &str| listed.contains(&file.with_extension(ending));
    for file in &listed {
        let (Some(name), Some(ending)) = (file.file_name(), file.extension().and_then(|ending| ending.to_str())) else {
            continue;
        };
        let hidden = name.as_encoded_bytes().starts_with(b".");
        let twice = ending == "png" && has(file, "svg") || ending == "gif" && has(file, "mp4");
        if !hidden && !twice && forms.contains(&ending) && file.is_file() {
            let film = ["mp4", "webm"].contains(&ending);
            found.push(Picture { relative: relative.join(name), name: name.to_string_lossy().into_owned(), film });
        }
    }
    found
}

/// Those of a run: in its folder, and in folders in it.
pub(crate) fn of_run(relative: &Relative, path: &Path) -> Markup {
    let mut found = in_folder(relative, path);
    for inner in files::list(path).unwrap_or_default() {
        let Some(name) = inner.file_name().filter(|_| inner.is_dir() && !inner.is_symlink()) else { continue };
        let plain = !name.as_encoded_bytes().starts_with(b".") && !WITHOUT.iter().any(|without| name == *without);
        if plain {
            found.extend(in_folder(&relative.join(name), &inner));
        }
    }
    let more = found.len().saturating_sub(MOST);
    found.truncate(MOST);
    html! {
        (shown(&found))
        @if more > 0 { p { "And " (more) " more in this folder." } }
    }
}

/// With a heading, if there are any.
pub(crate) fn shown(pictures: &[Picture]) -> Markup {
    html! {
        @if !pictures.is_empty() {
            h2 { "Pictures and films" }
            div.pictures { @for picture in pictures { (one(picture)) } }
        }
    }
}

fn one(Picture { relative, name, film }: &Picture) -> Markup {
    let address = format!("/file/{}", relative.encode());
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
