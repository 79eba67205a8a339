//! Import cycles between sibling modules.
//!
//! The imports form a graph of sibling modules, i.e. modules with the same parent. An import of `a::b` from `a::c::d`
//! is an edge from `a::c` to `a::b`: both paths are cut after the first name that differs. Imports between a module and
//! its own parent are not edges.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fmt;

use crate::imports::{ModulePath, PackageImports};

/// A cycle: sibling modules that all import each other, directly or through other modules of the cycle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Cycle {
    /// The folder of the package.
    pub folder: String,
    /// The path of the modules' common parent; empty for the crate's root.
    pub parent: ModulePath,
    /// The number of the parent's child modules that import another child module or are imported by one.
    pub siblings: usize,
    /// The names of all modules of the cycle, in alphabetical order.
    pub modules: Vec<String>,
    /// A shortest series of imports from one of these modules back to itself.
    pub path: Vec<Edge>,
}

/// An import of one sibling module by another. If there are several such imports, only the first is kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Edge {
    /// The name of the importing module.
    pub from: String,
    /// The name of the imported module.
    pub to: String,
    /// The file with the import.
    pub file: String,
    /// The line of the import, from 1.
    pub line: usize,
}

impl fmt::Display for Cycle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let parent = if self.parent.is_empty() { "the root".to_owned() } else { self.parent.join("::") };
        let count = self.modules.len();
        let siblings = self.siblings;
        let modules = self.modules.join(", ");
        write!(
            f,
            "{}: {count} of {siblings} modules of {parent} import each other: {modules}; for example",
            self.folder
        )?;
        for edge in &self.path {
            write!(f, "\n    {} -> {}  {}:{}", edge.from, edge.to, edge.file, edge.line)?;
        }
        Ok(())
    }
}

/// Finds all cycles of a package. Cycles among modules close to the root come first.
pub fn find(package: &PackageImports) -> Vec<Cycle> {
    let mut levels: BTreeMap<(usize, &[String]), SiblingGraph> = BTreeMap::new();
    for import in &package.imports {
        let common = import.from.iter().zip(&import.to).take_while(|(from, to)| from == to).count();
        if let (Some(from), Some(to)) = (import.from.get(common), import.to.get(common)) {
            let graph = levels.entry((common, &import.from[..common])).or_default();
            graph.add(Edge { from: from.clone(), to: to.clone(), file: import.file.clone(), line: import.line });
        }
    }
    let mut cycles = Vec::new();
    for ((_, parent), graph) in levels {
        for modules in graph.cycles() {
            cycles.push(Cycle {
                folder: package.folder.clone(),
                parent: parent.to_vec(),
                siblings: graph.names.len(),
                path: graph.shortest_cycle(&modules),
                modules,
            });
        }
    }
    cycles
}

#[derive(Default)]
struct SiblingGraph {
    names: BTreeSet<String>,
    edges: BTreeMap<String, BTreeMap<String, Edge>>,
}

impl SiblingGraph {
    fn add(&mut self, edge: Edge) {
        self.names.extend([edge.from.clone(), edge.to.clone()]);
        self.edges.entry(edge.from.clone()).or_default().entry(edge.to.clone()).or_insert(edge);
    }

    fn reachable(&self, start: &str) -> BTreeSet<&str> {
        let mut found = BTreeSet::new();
        let mut queue = VecDeque::from([start]);
        while let Some(name) = queue.pop_front() {
            for next in self.edges.get(name).into_iter().flat_map(BTreeMap::keys) {
                if found.insert(next.as_str()) {
                    queue.push_back(next);
                }
            }
        }
        found
    }

    /// Returns the strongly connected components that have more than one module.
    fn cycles(&self) -> Vec<Vec<String>> {
        let reachable: BTreeMap<_, _> = self.names.iter().map(|name| (name.as_str(), self.reachable(name))).collect();
        let mut done: BTreeSet<&str> = BTreeSet::new();
        let mut cycles = Vec::new();
        for (name, targets) in &reachable {
            let modules: Vec<_> = targets.iter().filter(|target| reachable[**target].contains(name)).copied().collect();
            if !modules.is_empty() && !done.contains(name) {
                done.extend(modules.iter().copied());
                cycles.push(modules.into_iter().map(str::to_owned).collect());
            }
        }
        cycles
    }

    /// Returns a shortest cycle among `modules`. If several cycles are equally short, returns the one whose first
    /// module comes first in alphabetical order.
    fn shortest_cycle(&self, modules: &[String]) -> Vec<Edge> {
        modules.iter().filter_map(|start| self.shortest_path_back(start)).min_by_key(Vec::len).unwrap_or_default()
    }

    fn shortest_path_back(&self, start: &str) -> Option<Vec<Edge>> {
        let mut arrived_by: BTreeMap<&str, &Edge> = BTreeMap::new();
        let mut queue = VecDeque::from([start]);
        while let Some(name) = queue.pop_front() {
            for (next, edge) in self.edges.get(name)? {
                if !arrived_by.contains_key(next.as_str()) {
                    arrived_by.insert(next, edge);
                    queue.push_back(next);
                }
            }
            if arrived_by.contains_key(start) {
                break;
            }
        }
        let mut path = vec![(*arrived_by.get(start)?).clone()];
        while path.last().is_some_and(|edge| edge.from != start) {
            let from = path.last().map(|edge| edge.from.clone())?;
            path.push((*arrived_by.get(from.as_str())?).clone());
        }
        path.reverse();
        Some(path)
    }
}
