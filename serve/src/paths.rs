//! The paths of files and folders below the served folder, as pages' addresses contain them. Also lists the kinds of
//! files that the server sends.

use std::ffi::OsStr;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::{Path, PathBuf};

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, percent_decode_str, percent_encode};
use perturb_files::require_folder;

use crate::error::ServeError;

/// Bytes that are percent-encoded in addresses: all except letters, digits and `-_.~`.
const ESCAPED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'_').remove(b'.').remove(b'~');

/// The served folder.
#[derive(Clone, Debug)]
pub(crate) struct Root {
    /// Absolute path without symbolic links.
    path: PathBuf,
    /// Path as the user gave it.
    given: PathBuf,
}

/// A path relative to the served folder, without `..` and without hidden names. It is empty for the served folder
/// itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct RelativePath(PathBuf);

impl Root {
    /// Opens the folder at `given`.
    ///
    /// # Errors
    /// [`ServeError`] if there is no folder or it cannot be read.
    pub(crate) fn open(given: &Path) -> Result<Self, ServeError> {
        let no_folder = || ServeError::NoFolder { path: given.to_owned() };
        if !given.is_dir() {
            return Err(no_folder());
        }
        require_folder(given)?;
        Ok(Self { path: given.canonicalize().map_err(|_| no_folder())?, given: given.to_owned() })
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the path as the user gave it.
    pub(crate) fn given(&self) -> &Path {
        &self.given
    }

    /// Returns the absolute path of `relative`, with symbolic links resolved. Returns `None` if it does not exist, if
    /// it is outside of the served folder, or if it is hidden.
    pub(crate) fn resolve(&self, relative: &RelativePath) -> Option<PathBuf> {
        let real = self.path.join(&relative.0).canonicalize().ok()?;
        self.relative(&real).map(|_| real)
    }

    /// Returns the absolute path `path` relative to the served folder. Returns `None` if it is outside or hidden.
    pub(crate) fn relative(&self, path: &Path) -> Option<RelativePath> {
        let names = path.strip_prefix(&self.path).ok()?;
        names.iter().all(is_visible_name).then(|| RelativePath(names.to_owned()))
    }
}

impl RelativePath {
    /// Decodes the percent-encoded path in an address. Returns `None` for invalid and hidden paths.
    pub(crate) fn decode(text: &str) -> Option<Self> {
        let text = text.strip_suffix('/').unwrap_or(text);
        let mut path = PathBuf::new();
        for name in text.split('/').filter(|_| !text.is_empty()) {
            let name = std::ffi::OsString::from_vec(percent_decode_str(name).collect());
            path.push(is_visible_name(&name).then_some(name)?);
        }
        Some(Self(path))
    }

    /// Returns the percent-encoded path for an address.
    pub(crate) fn encode(&self) -> String {
        let names = self.0.iter().map(|name| percent_encode(name.as_bytes(), ESCAPED).to_string());
        names.collect::<Vec<_>>().join("/")
    }

    /// Returns the path with a name appended.
    pub(crate) fn join(&self, name: impl AsRef<Path>) -> Self {
        Self(self.0.join(name))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

/// Tells whether `name` is a single file name that is not hidden. `.` and `..` count as hidden.
fn is_visible_name(name: &OsStr) -> bool {
    let bytes = name.as_bytes();
    !bytes.is_empty() && bytes[0] != b'.' && !bytes.contains(&b'/') && !bytes.contains(&0)
}

/// Names of text files that are sent, with their media types.
const TEXT_FILES: [(&str, &str); 7] = [
    ("config.toml", "text/plain; charset=utf-8"),
    ("plan.toml", "text/plain; charset=utf-8"),
    ("log.txt", "text/plain; charset=utf-8"),
    ("result.json", "application/json"),
    ("failure.json", "application/json"),
    ("timing.json", "application/json"),
    ("report.md", "text/plain; charset=utf-8"),
];
/// File name extensions of tables, pictures and films that are sent, with their media types.
const MEDIA_EXTENSIONS: [(&str, &str); 6] = [
    ("csv", "text/csv; charset=utf-8"),
    ("svg", "image/svg+xml"),
    ("png", "image/png"),
    ("gif", "image/gif"),
    ("mp4", "video/mp4"),
    ("webm", "video/webm"),
];

/// Returns the media type of the file at `path`. Returns `None` if files with such a name are not sent.
pub(crate) fn media_type(path: &Path) -> Option<&'static str> {
    let name = path.file_name()?.to_str()?;
    let extension = path.extension().and_then(OsStr::to_str).unwrap_or_default();
    let find = |known: &[(&str, &'static str)], wanted: &str| {
        known.iter().find(|(name, _)| *name == wanted).map(|(_, kind)| *kind)
    };
    find(&TEXT_FILES, name).or_else(|| find(&MEDIA_EXTENSIONS, extension))
}

#[cfg(test)]
mod tests {
    use rstest::rstest;

    use super::*;

    #[rstest]
    #[case("a/b.svg", Some("a/b.svg"))]
    #[case("", Some(""))]
    #[case("a/", Some("a"))]
    #[case("a%20b/%C3%BC", Some("a b/ü"))]
    #[case("a%2Bb+c", Some("a+b+c"))]
    #[case("..", None)]
    #[case("../a", None)]
    #[case("a/../../b", None)]
    #[case("a/..", None)]
    #[case("%2e%2e/a", None)]
    #[case("%2E%2e%2fa", None)]
    #[case("..%2fa", None)]
    #[case("a%2fb", None)]
    #[case("%2fetc/passwd", None)]
    #[case("/etc/passwd", None)]
    #[case("a//b", None)]
    #[case("./a", None)]
    #[case("a%00.svg", None)]
    #[case(".ssh/id", None)]
    fn addresses_name_visible_paths_below_the_folder(#[case] text: &str, #[case] expected: Option<&str>) {
        assert_eq!(RelativePath::decode(text), expected.map(|path| RelativePath(path.into())));
    }

    #[test]
    fn names_of_any_bytes_survive_encoding() {
        let name = OsStr::from_bytes(b"\xff%2f\" <&?#\n");
        let relative = RelativePath(Path::new("a").join(name));
        assert_eq!(RelativePath::decode(&relative.encode()), Some(relative.clone()));
        assert!(relative.encode().bytes().all(|byte| byte.is_ascii_graphic() && !b"\"<>&?#".contains(&byte)));
    }

    #[test]
    fn links_out_of_the_folder_resolve_to_nothing() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        std::fs::create_dir_all(path("runs/inside")).unwrap();
        std::fs::write(path("secret.csv"), "x").unwrap();
        std::fs::write(path("runs/inside/a.csv"), "x").unwrap();
        for (to, name) in [("secret.csv", "out.csv"), ("", "up"), ("runs/inside", "in")] {
            std::os::unix::fs::symlink(path(to), path("runs").join(name)).unwrap();
        }
        let root = Root::open(&path("runs")).unwrap();
        let resolved = |text: &str| root.resolve(&RelativePath::decode(text).unwrap());
        assert_eq!((resolved("out.csv"), resolved("up/secret.csv"), resolved("missing")), (None, None, None));
        assert_eq!(resolved("in/a.csv"), resolved("inside/a.csv"));
        assert_eq!(resolved(""), Some(root.path().to_owned()));
        assert_eq!(root.relative(&root.path().join("inside/a.csv")).unwrap().encode(), "inside/a.csv");
        assert_eq!((root.relative(directory.path()), root.relative(&root.path().join(".git"))), (None, None));
    }

    #[rstest]
    #[case("a/heatmap.svg", true)]
    #[case("film.mp4", true)]
    #[case("monitor.csv", true)]
    #[case("config.toml", true)]
    #[case("Cargo.toml", false)]
    #[case("page.html", false)]
    #[case("key.pem", false)]
    #[case("svg", false)]
    #[case("weights-1.safetensors", false)]
    fn only_known_kinds_of_files_are_sent(#[case] path: &str, #[case] sent: bool) {
        assert_eq!(media_type(Path::new(path)).is_some(), sent);
    }
}
