//! The imports of crates: follows `mod` items to find all modules, and reads every path in them.

use super::scan::{self, Item};
use super::{Binding, ModulePath, Modules, PackageImports, WrittenPath};
use crate::source::SourceTree;

/// Reads the imports of every crate of the workspace, in its library and in each of its programs.
pub(super) fn packages(tree: &SourceTree) -> Vec<PackageImports> {
    let manifests = tree.iter().filter(|(path, _)| *path == "Cargo.toml" || path.ends_with("/Cargo.toml"));
    manifests
        .filter(|(_, text)| text.lines().any(|line| line.trim() == "[package]"))
        .map(|(path, text)| {
            let folder = path.strip_suffix("Cargo.toml").unwrap_or_default().trim_end_matches('/').to_owned();
            let imports = crate_roots(tree, &folder, text).iter().flat_map(|root| crate_imports(tree, root)).collect();
            PackageImports { folder: if folder.is_empty() { ".".to_owned() } else { folder }, imports }
        })
        .collect()
}

/// Returns the root files of a package's library and programs.
fn crate_roots(tree: &SourceTree, folder: &str, manifest: &str) -> Vec<String> {
    let mut roots = vec![join(folder, "src/lib.rs"), join(folder, "src/main.rs")];
    let programs = join(folder, "src/bin/");
    roots
        .extend(tree.with_extension(".rs").map(|(path, _)| path.to_owned()).filter(|path| path.starts_with(&programs)));
    let mut section = "";
    for line in manifest.lines().map(str::trim) {
        if line.starts_with('[') {
            section = line;
        } else if matches!(section, "[lib]" | "[[bin]]")
            && let Some((key, value)) = line.split_once('=')
            && key.trim() == "path"
        {
            roots.push(join(folder, value.split('#').next().unwrap_or_default().trim().trim_matches('"')));
        }
    }
    roots.retain(|root| tree.get(root).is_some());
    roots.sort();
    roots.dedup();
    roots
}

fn join(folder: &str, path: &str) -> String {
    if folder.is_empty() { path.to_owned() } else { format!("{folder}/{path}") }
}

fn folder_part(path: &str) -> &str {
    path.rsplit_once('/').map_or("", |(folder, _)| folder)
}

/// Removes each `..` together with the folder before it.
fn normalise(path: &str) -> String {
    let mut parts = Vec::new();
    for part in path.split('/') {
        if part == ".." {
            parts.pop();
        } else {
            parts.push(part);
        }
    }
    parts.join("/")
}

fn crate_imports(tree: &SourceTree, root: &str) -> Vec<super::Import> {
    let mut modules = Modules::default();
    read_file(tree, root, folder_part(root), ModulePath::new(), &mut modules);
    modules.imports()
}

/// Reads one file and, recursively, the files of its child modules, which are searched in the folder `children`.
fn read_file(tree: &SourceTree, file: &str, children: &str, module: ModulePath, modules: &mut Modules) {
    let Some(source) = tree.get(file) else { return };
    modules.modules.insert(module.clone());
    for item in scan::items(source) {
        match item {
            Item::InlineModule { inside } => {
                modules.modules.insert(absolute(&module, &inside));
            }
            Item::Module { inside, name, path } => {
                let folder = inside.iter().fold(children.to_owned(), |folder, name| join(&folder, name));
                let mut child = absolute(&module, &inside);
                child.push(name.clone());
                // The possible files of the child module, each with the folder of that module's own children.
                let candidates = match path {
                    Some(path) => {
                        let path = normalise(&join(folder_part(file), &path));
                        let own = folder_part(&path).to_owned();
                        vec![(path, own)]
                    }
                    None => {
                        let own = join(&folder, &name);
                        vec![(format!("{own}.rs"), own.clone()), (join(&own, "mod.rs"), own)]
                    }
                };
                if let Some((path, own)) = candidates.into_iter().find(|(path, _)| tree.get(path).is_some()) {
                    read_file(tree, &path, &own, child, modules);
                }
            }
            Item::Use { inside, name, target, line } => {
                let module = absolute(&module, &inside);
                modules.paths.push(WrittenPath {
                    module: module.clone(),
                    names: target.clone(),
                    file: file.to_owned(),
                    line,
                });
                modules.bindings.entry(module).or_default().push(Binding { name, target });
            }
            Item::Path { inside, names, line } => {
                modules.paths.push(WrittenPath {
                    module: absolute(&module, &inside),
                    names,
                    file: file.to_owned(),
                    line,
                });
            }
        }
    }
}

fn absolute(module: &[String], inside: &[String]) -> ModulePath {
    module.iter().chain(inside).cloned().collect()
}
