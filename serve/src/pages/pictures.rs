//! The section of a page with pictures and films.

use maud::{Markup, html};
use perturb_text::grouped;

use crate::pictures::{Pictures, RunPicture};

/// Returns the section with pictures under a heading. It is empty if there are none.
pub(crate) fn section(pictures: &Pictures) -> Markup {
    html! {
        @if !pictures.shown.is_empty() {
            h2 { "Pictures and films" }
            div.pictures { @for picture in &pictures.shown { (figure(picture)) } }
        }
        @if pictures.more > 0 { p { "And " (grouped(pictures.more)) " more pictures and films." } }
    }
}

fn figure(RunPicture { relative, name, is_film, stamp }: &RunPicture) -> Markup {
    let address = format!("/file/{}?v={}", relative.encode(), stamp.tag());
    html! {
        figure {
            @if *is_film {
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
    use crate::paths::RelativePath;
    use crate::pictures::scan_run;

    #[test]
    fn pictures_have_addresses_of_their_content() {
        let directory = tempfile::tempdir().unwrap();
        let write = |text: &str| std::fs::write(directory.path().join("a.png"), text).unwrap();
        let page = || section(&scan_run(&RelativePath::default(), directory.path())).0;
        write("x");
        let before = page();
        write("another");
        assert_ne!(page(), before);
        let more = Pictures { shown: Vec::new(), more: 1_940 };
        assert!(section(&more).0.contains("And 1 940 more"));
    }
}
