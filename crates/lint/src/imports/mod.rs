//! Imports between the modules of a crate or of a Python package.

pub mod python;
pub mod rust;
mod scan;

use std::collections::{BTreeMap, BTreeSet};

/// Longest chain of re-exports that is followed.
const MAX_REEXPORTS: usize = 16;

/// A module's names from the crate's root downwards. The root itself has none.
pub type ModulePath = Vec<String>;

/// A place at which a module names another one of the same package.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Import {
    /// The module in which the name stands.
    pub from: ModulePath,
    /// The module that is named. Re-exports are followed to the module that defines the item.
    pub to: ModulePath,
    /// File in which the name stands.
    pub file: String,
    /// Line of the file, counted from 1.
    pub line: usize,
}

/// The imports of one crate, one program or one Python package.
#[derive(Clone, Debug)]
pub struct PackageImports {
    /// Folder of its `Cargo.toml`, or of its Python modules; `.` for the repository's root.
    pub folder: String,
    /// Imports of the package, in the order of files and lines.
    pub imports: Vec<Import>,
}

/// Reads the imports of every crate and Python package of `tree`, without their tests.
pub fn read(tree: &crate::source::SourceTree) -> Vec<PackageImports> {
    let mut packages = rust::packages(tree);
    packages.extend(python::packages(tree));
    packages
}

/// A path as it is written, with where it stands. The first name may be `crate`, `self` or `super`.
#[derive(Clone, Debug)]
struct WrittenPath {
    module: ModulePath,
    names: Vec<String>,
    file: String,
    line: usize,
}

/// The names that a `use` or an `import` makes in a module.
#[derive(Clone, Debug)]
struct Binding {
    /// `None` stands for all public names of the target: `use target::*`.
    name: Option<String>,
    target: Vec<String>,
}

/// The end of a path within the package.
#[derive(Clone, Debug)]
enum ResolvedPath {
    Module(ModulePath),
    /// An item that the module defines, or imports from another package.
    ItemOf(ModulePath),
}

impl ResolvedPath {
    fn into_module(self) -> ModulePath {
        match self {
            Self::Module(path) | Self::ItemOf(path) => path,
        }
    }
}

/// Everything that is known of a package's modules before paths are resolved.
#[derive(Debug, Default)]
struct Modules {
    modules: BTreeSet<ModulePath>,
    bindings: BTreeMap<ModulePath, Vec<Binding>>,
    paths: Vec<WrittenPath>,
}

impl Modules {
    /// Returns the path of `parent`'s module `name`, if there is one.
    fn child(&self, parent: &[String], name: &str) -> Option<ModulePath> {
        let mut path = parent.to_vec();
        path.push(name.to_owned());
        self.modules.contains(&path).then_some(path)
    }

    /// Resolves every written path. Paths that lead out of the package give no import.
    fn imports(&self) -> Vec<Import> {
        let mut imports = BTreeSet::new();
        for path in &self.paths {
            if let Some(to) = self.resolve(&path.module, &path.names, 0).map(ResolvedPath::into_module) {
                let from = path.module.clone();
                imports.insert((
                    path.file.clone(),
                    path.line,
                    Import { from, to, file: path.file.clone(), line: path.line },
                ));
            }
        }
        imports.into_iter().map(|(_, _, import)| import).collect()
    }

    /// Finds the module that `names` names, or that defines the item which `names` names, seen from `module`.
    /// Returns `None` if it is outside the package.
    fn resolve(&self, module: &[String], names: &[String], reexports: usize) -> Option<ResolvedPath> {
        if reexports > MAX_REEXPORTS {
            return None;
        }
        let (first, mut rest) = names.split_first()?;
        let mut current = match first.as_str() {
            "crate" => ResolvedPath::Module(ModulePath::new()),
            "self" => ResolvedPath::Module(module.to_vec()),
            "super" => ResolvedPath::Module(module.split_last()?.1.to_vec()),
            name => match self.child(module, name) {
                Some(child) => ResolvedPath::Module(child),
                None => self.reexport(module, name, reexports)?,
            },
        };
        while let (ResolvedPath::Module(path), Some((name, after))) = (&current, rest.split_first()) {
            current = match name.as_str() {
                "self" => ResolvedPath::Module(path.clone()),
                "super" => ResolvedPath::Module(path.split_last()?.1.to_vec()),
                name => match self.child(path, name) {
                    Some(child) => ResolvedPath::Module(child),
                    None => self.reexport(path, name, reexports).unwrap_or(ResolvedPath::ItemOf(path.clone())),
                },
            };
            rest = after;
        }
        Some(current)
    }

    /// Finds what `module` imports as `name`.
    fn reexport(&self, module: &[String], name: &str, reexports: usize) -> Option<ResolvedPath> {
        let bindings = self.bindings.get(module)?;
        if let Some(binding) = bindings.iter().find(|binding| binding.name.as_deref() == Some(name)) {
            return self.resolve(module, &binding.target, reexports + 1);
        }
        bindings.iter().filter(|binding| binding.name.is_none()).find_map(|glob| {
            let target = match self.resolve(module, &glob.target, reexports + 1)? {
                ResolvedPath::Module(target) if target != module => target,
                _ => return None,
            };
            match self.child(&target, name) {
                Some(child) => Some(ResolvedPath::Module(child)),
                None => self.reexport(&target, name, reexports + 1),
            }
        })
    }
}
