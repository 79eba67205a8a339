//! Imports between the modules of a crate or of a Python package.

pub mod python;
pub mod rust;
mod scan;

use std::collections::{BTreeMap, BTreeSet};

/// Maximum number of re-exports that are followed to find the definition of an item.
const MAX_REEXPORTS: usize = 16;

/// The path of a module: its names from the crate's root downwards. The root's path is empty.
pub type ModulePath = Vec<String>;

/// An import: a line in one module that names another module of the same package, or an item in it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Import {
    /// The module that contains the import.
    pub from: ModulePath,
    /// The imported module. For a re-exported item, it is the module that defines the item.
    pub to: ModulePath,
    /// The file with the import.
    pub file: String,
    /// The line in the file, from 1.
    pub line: usize,
}

/// The imports of one crate, one program or one Python package.
#[derive(Clone, Debug)]
pub struct PackageImports {
    /// The folder of the `Cargo.toml` or of the Python modules; `.` for the repository's root.
    pub folder: String,
    /// The imports, ordered by file and line.
    pub imports: Vec<Import>,
}

/// Reads the imports of every crate and every Python package in `tree`, except in tests.
pub fn read(tree: &crate::source::SourceTree) -> Vec<PackageImports> {
    let mut packages = rust::packages(tree);
    packages.extend(python::packages(tree));
    packages
}

/// A path as it is written in the source, with its location. The first name may be `crate`, `self` or `super`.
#[derive(Clone, Debug)]
struct WrittenPath {
    module: ModulePath,
    names: Vec<String>,
    file: String,
    line: usize,
}

/// A name that a `use` or an `import` defines in a module.
#[derive(Clone, Debug)]
struct Binding {
    /// The name; `None` in `use target::*`, which imports all public names of the target.
    name: Option<String>,
    target: Vec<String>,
}

/// The module or item in the package to which a path leads.
#[derive(Clone, Debug)]
enum ResolvedPath {
    Module(ModulePath),
    /// An item that this module defines, or imports from another package.
    ItemOf(ModulePath),
}

impl ResolvedPath {
    fn into_module(self) -> ModulePath {
        match self {
            Self::Module(path) | Self::ItemOf(path) => path,
        }
    }
}

/// The modules of a package, with the paths in them before they are resolved.
#[derive(Debug, Default)]
struct Modules {
    modules: BTreeSet<ModulePath>,
    bindings: BTreeMap<ModulePath, Vec<Binding>>,
    paths: Vec<WrittenPath>,
}

impl Modules {
    /// Returns the path of the child module `name` of `parent`, if it exists.
    fn child(&self, parent: &[String], name: &str) -> Option<ModulePath> {
        let mut path = parent.to_vec();
        path.push(name.to_owned());
        self.modules.contains(&path).then_some(path)
    }

    /// Resolves all paths to imports. Ignores paths that lead out of the package.
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

    /// Resolves the path `names` that is written in `module`. Returns `None` if the path leads out of the package, or
    /// after too many re-exports. `reexports` is the number of re-exports that were followed so far.
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

    /// Resolves `name` if `module` imports it, by its own name or with `*`.
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
