//! Which paths below the folder an address can name, and what of it is sent.

use std::ffi::OsStr;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::{Path, PathBuf};

use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, percent_decode_str, percent_encode};
use perturb_study::files::require_folder;

use crate::error::ServeError;

/// What stands for itself in an address.
const PLAIN: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'_').remove(b'.').remove(b'~');

/// The folder that is served.
#[derive(Clone, Debug)]
pub(crate) struct Root {
    /// Without symbolic links.
    path: PathBuf,
    /// As it was given.
    given: PathBuf,
}

/// A path below the folder, whose names are all plain: nothing leads up, and nothing is hidden. Empty for the folder itself.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Relative(PathBuf);

impl Root {
    /// The folder at `given`, which must be there now.
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

    /// As it was given.
    pub(crate) fn given(&self) -> &Path {
        &self.given
    }

    /// What `relative` names, without symbolic links; `None` if nothing is there, or it is not below the folder.
    pub(crate) fn resolve(&self, relative: &Relative) -> Option<PathBuf> {
        let real = self.path.join(&relative.0).canonicalize().ok()?;
        self.relative(&real).map(|_| real)
    }

    /// The name of what is at `path`; `None` if it is not below the folder, or hidden.
    pub(crate) fn relative(&self, path: &Path) -> Option<Relative> {
        let names = path.strip_prefix(&self.path).ok()?;
        names.iter().all(is_plain).then(|| Relative(names.to_owned()))
    }
}

impl Relative {
    /// What an address means by `text`, in which bytes may be written as `%41`; `None` for what names no path, or a hidden
    /// one.
    pub(crate) fn decode(text: &str) -> Option<Self> {
        let text = text.strip_suffix('/').unwrap_or(text);
        let mut path = PathBuf::new();
        for name in text.split('/').filter(|_| !text.is_empty()) {
            let name = std::ffi::OsString::from_vec(percent_decode_str(name).collect());
            path.push(is_plain(&name).then_some(name)?);
        }
        Some(Self(path))
    }

    /// As an address has it.
    pub(crate) fn encode(&self) -> String {
        let names = self.0.iter().map(|name| percent_encode(name.as_bytes(), PLAIN).to_string());
        names.collect::<Vec<_>>().join("/")
    }

    /// With another name behind it.
    pub(crate) fn join(&self, name: impl AsRef<Path>) -> Self {
        Self(self.0.join(name))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

/// Whether `name` is that of a file or a folder in the one before it, and not hidden.
fn is_plain(name: &OsStr) -> bool {
    let bytes = name.as_bytes();
    !bytes.is_empty() && bytes[0] != b'.' && !bytes.contains(&b'/') && !bytes.contains(&0)
}

/// Names of text files that runs write.
const TEXTS: [(&str, &str); 7] = [
    ("config.toml", "text/plain; charset=utf-8"),
    ("plan.toml", "text/plain; charset=utf-8"),
    ("log.txt", "text/plain; charset=utf-8"),
    ("result.json", "application/json"),
    ("failure.json", "application/json"),
    ("timing.json", "application/json"),
    ("report.md", "text/plain; charset=utf-8"),
];
/// Endings of tables, pictures and films.
const ENDINGS: [(&str, &str); 6] = [
    ("csv", "text/csv; charset=utf-8"),
    ("svg", "image/svg+xml"),
    ("png", "image/png"),
    ("gif", "image/gif"),
    ("mp4", "video/mp4"),
    ("webm", "video/webm"),
];

/// The type of the file at `path`; `None` for those that are not sent.
pub(crate) fn media_type(path: &Path) -> Option<&'static str> {
    let name = path.file_name()?.to_str()?;
    let ending = path.extension().and_then(OsStr::to_str).unwrap_or_default();
    let of = |known: &[(&str, &'static str)], wanted: &str| {
        known.iter().find(|(name, _)| *name == wanted).map(|(_, kind)| *kind)
    };
    of(&TEXTS, name).or_else(|| of(&ENDINGS, ending))
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
    fn an_address_names_what_is_below_and_nothing_else(#[case] text: &str, #[case] expected: Option<&str>) {
        assert_eq!(Relative::decode(text), expected.map(|path| Relative(path.into())));
    }

    #[test]
    fn whatever_bytes_a_name_has_it_comes_back() {
        let name = OsStr::from_bytes(b"\xff%2f\" <&?#\n");
        let relative = Relative(Path::new("a").join(name));
        assert_eq!(Relative::decode(&relative.encode()), Some(relative.clone()));
        assert!(relative.encode().bytes().all(|byte| byte.is_ascii_graphic() && !b"\"<>&?#".contains(&byte)));
    }

    #[test]
    fn links_that_lead_out_lead_nowhere() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        std::fs::create_dir_all(path("runs/inside")).unwrap();
        std::fs::write(path("secret.csv"), "x").unwrap();
        std::fs::write(path("runs/inside/a.csv"), "x").unwrap();
        for (to, name) in [("secret.csv", "out.csv"), ("", "up"), ("runs/inside", "in")] {
            std::os::unix::fs::symlink(path(to), path("runs").join(name)).unwrap();
        }
        let root = Root::open(&path("runs")).unwrap();
        let resolved = |text: &str| root.resolve(&Relative::decode(text).unwrap());
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
