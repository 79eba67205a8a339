//! The imports of Python packages: every `import` statement, even in functions or under `if TYPE_CHECKING`.

use super::{Binding, ModulePath, Modules, PackageImports, WrittenPath};
use crate::source::{SourceTree, is_test};

/// Reads the imports of every Python package, which is a folder with an `__init__.py` whose parent has none.
pub(super) fn packages(tree: &SourceTree) -> Vec<PackageImports> {
    let mut folders: Vec<_> = tree
        .iter()
        .filter_map(|(path, _)| path.strip_suffix("/__init__.py"))
        .filter(|folder| !is_test(folder))
        .collect();
    let all = folders.clone();
    folders.retain(|folder| !folder.rsplit_once('/').is_some_and(|(parent, _)| all.contains(&parent)));
    folders
        .into_iter()
        .map(|folder| PackageImports { folder: folder.to_owned(), imports: imports(tree, folder) })
        .collect()
}

fn imports(tree: &SourceTree, folder: &str) -> Vec<super::Import> {
    let package = folder.rsplit('/').next().unwrap_or(folder);
    let files: Vec<_> = tree
        .with_extension(".py")
        .filter(|(path, _)| path.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/')) && !is_test(path))
        .collect();
    let mut modules = Modules::default();
    for (path, source) in files {
        let name = path[folder.len() + 1..].trim_end_matches(".py");
        let is_package = name == "__init__" || name.ends_with("/__init__");
        let mut module: ModulePath = name.split('/').map(str::to_owned).collect();
        if is_package {
            module.pop();
        }
        modules.modules.insert(module.clone());
        for statement in statements(source) {
            for (name, target) in bindings(&statement.text, package, &module, is_package) {
                let names = target.clone();
                modules.paths.push(WrittenPath {
                    module: module.clone(),
                    names,
                    file: path.to_owned(),
                    line: statement.line,
                });
                modules.bindings.entry(module.clone()).or_default().push(Binding { name, target });
            }
        }
    }
    modules.imports()
}

struct Statement {
    text: String,
    line: usize,
}

/// Returns the import statements of a file, each joined to one line, without comments and parentheses.
fn statements(source: &str) -> Vec<Statement> {
    let mut statements = Vec::new();
    let mut lines = code_lines(source).into_iter().enumerate();
    while let Some((index, text)) = lines.next() {
        let start = text.trim_start();
        if !(start.starts_with("import ") || start.starts_with("from ")) {
            continue;
        }
        let mut text = start.to_owned();
        while text.matches('(').count() > text.matches(')').count() || text.trim_end().ends_with('\\') {
            let Some((_, next)) = lines.next() else { break };
            text = format!("{} {}", text.trim_end().trim_end_matches('\\'), next.trim());
        }
        statements.push(Statement { text: text.replace(['(', ')'], " "), line: index + 1 });
    }
    statements
}

/// Returns the lines of a file without comments and without the content of string literals.
fn code_lines(source: &str) -> Vec<String> {
    let mut code = String::new();
    let mut quote: Option<&str> = None;
    let mut rest = source;
    while let Some(c) = rest.chars().next() {
        let mut taken = c.len_utf8();
        if let Some(end) = quote {
            if c == '\\' {
                taken += rest[1..].chars().next().map_or(0, char::len_utf8);
            } else if rest.starts_with(end) {
                taken = end.len();
                quote = None;
            } else if c == '\n' && end.len() == 1 {
                quote = None;
            }
            code.extend(rest[..taken].matches('\n'));
        } else if c == '#' {
            taken = rest.find('\n').unwrap_or(rest.len());
        } else if let Some(start) = ["\"\"\"", "'''", "\"", "'"].into_iter().find(|start| rest.starts_with(start)) {
            taken = start.len();
            quote = Some(start);
        } else {
            code.push(c);
        }
        rest = &rest[taken..];
    }
    code.lines().map(str::to_owned).collect()
}

/// Returns the names that an import statement defines, each with the path of its target. A path starts with `crate`, as
/// in Rust. The name is `None` for `*`.
fn bindings(text: &str, package: &str, module: &[String], is_package: bool) -> Vec<(Option<String>, Vec<String>)> {
    let mut words = text.split_whitespace();
    match words.next() {
        Some("import") => {
            let parts = text.trim_start_matches("import").split(',');
            parts
                .filter_map(|part| {
                    let mut words = part.split_whitespace();
                    let name = words.next()?;
                    let alias = words.nth(1).unwrap_or(package);
                    Some((Some(alias.to_owned()), absolute(name, package, module, is_package)?))
                })
                .collect()
        }
        Some("from") => {
            let Some(source) = words.next() else { return Vec::new() };
            let Some(target) = absolute(source, package, module, is_package) else { return Vec::new() };
            let Some((_, names)) = text.split_once(" import ") else { return Vec::new() };
            names
                .split(',')
                .filter_map(|part| {
                    let mut words = part.split_whitespace();
                    let name = words.next()?;
                    if name == "*" {
                        return Some((None, target.clone()));
                    }
                    let alias = words.nth(1).unwrap_or(name);
                    Some((Some(alias.to_owned()), target.iter().cloned().chain([name.to_owned()]).collect()))
                })
                .collect()
        }
        _ => Vec::new(),
    }
}

/// Returns the path of a module from the package's root, which is called `crate`. Returns `None` for modules of other
/// packages.
fn absolute(source: &str, package: &str, module: &[String], is_package: bool) -> Option<Vec<String>> {
    let dots = source.chars().take_while(|&c| c == '.').count();
    let mut path = vec!["crate".to_owned()];
    let names = if dots == 0 {
        let names = source.strip_prefix(package)?;
        if !(names.is_empty() || names.starts_with('.')) {
            return None;
        }
        names.trim_start_matches('.')
    } else {
        let up = dots - usize::from(is_package);
        path.extend_from_slice(&module[..module.len().checked_sub(up)?]);
        &source[dots..]
    };
    path.extend(names.split('.').filter(|name| !name.is_empty()).map(str::to_owned));
    Some(path)
}
