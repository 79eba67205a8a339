//! Makes links between pages relative, so that they work behind a reverse proxy that serves the page below any path.
//!
//! Pages are written with absolute links such as `href="/run/a"`, which are then replaced. Texts from files cannot
//! contain such a link, because their quotes are escaped.

use crate::paths::RelativePath;

/// The attributes that contain links, up to the opening quote.
const ATTRIBUTES: [&str; 3] = ["href=\"", "src=\"", "data-events=\""];

/// The relative path from a page to the root of the site, such as `./` or `../../`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RelativeRoot(String);

impl RelativeRoot {
    /// Returns the relative path to the root from the page with the list of all runs.
    pub(crate) fn from_index() -> Self {
        Self::from_path("/")
    }

    /// Returns the relative path to the root from the page of a run. The page's address ends with a slash only if the
    /// run is the served folder itself.
    pub(crate) fn from_run(relative: &RelativePath) -> Self {
        Self("../".repeat(relative.path().iter().count().max(1)))
    }

    /// Returns the relative path to the root from the page with the absolute path `path`.
    pub(crate) fn from_path(path: &str) -> Self {
        match path.matches('/').count() {
            0 | 1 => Self("./".into()),
            count => Self("../".repeat(count - 1)),
        }
    }

    /// Returns the HTML of a page or of a part of a page, with relative links instead of absolute ones.
    pub(crate) fn relative_links(&self, html: &str) -> String {
        ATTRIBUTES.iter().fold(html.to_owned(), |html, attribute| {
            html.replace(&format!("{attribute}/"), &format!("{attribute}{}", self.0))
        })
    }
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("/", "./")]
    #[case("/run/", "../")]
    #[case("/run/a", "../")]
    #[case("/run/a/b", "../../")]
    #[case("/nothing", "./")]
    #[case("/report/a/b/", "../../../")]
    fn the_way_up_follows_from_the_address(#[case] path: &str, #[case] way: &str) {
        assert_eq!(RelativeRoot::from_path(path), RelativeRoot(way.into()));
        if let Some(run) = path.strip_prefix("/run/") {
            assert_eq!(RelativeRoot::from_run(&RelativePath::decode(run).unwrap()), RelativeRoot(way.into()));
        }
    }

    #[test]
    fn links_become_relative_and_texts_stay() {
        let html = r#"<a href="/run/a">href=&quot;/x</a><img src="/file/b.png"><body data-events="/events"><a href="https://x/">"#;
        let expected = r#"<a href="../run/a">href=&quot;/x</a><img src="../file/b.png"><body data-events="../events"><a href="https://x/">"#;
        assert_eq!(RelativeRoot::from_path("/run/a").relative_links(html), expected);
    }
}
