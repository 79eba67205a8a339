//! Limits of every check by folder, and the exemptions of types that share a name.
//!
//! Both files are written in the part of TOML that they need: `[section]`, `key = value`, and comments on lines of
//! their own.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Write as _};

use crate::cycles;
use crate::doc_comments;
use crate::glossary;
use crate::imports;
use crate::names::{self, Definition};
use crate::source::{GLOSSARY, SourceTree, folder_of};

/// Share of doc comments without a subject that every folder may have, in percent.
pub const SHARE_LIMIT: f64 = 2.0;

/// Most findings that a failed check prints for each folder, unless all are asked for.
const MAX_EXAMPLES: usize = 10;

/// A check with limits of its own, which are the section of this name in the file of limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Check {
    /// Number of modules in import cycles, by package.
    ImportCycles,
    /// Share of doc comments that open without a subject, in percent, by folder.
    DocComments,
    /// Number of type names defined in more than one file and not exempt, in the whole repository.
    TypesDefinedTwice,
    /// Number of constants with superlative names, by folder.
    SuperlativeConstants,
    /// Number of functions called `of`, by folder.
    FunctionsCalledOf,
    /// Number of tests with names of more than 60 characters, by folder.
    LongTestNames,
    /// Number of public types that the glossary does not explain, by folder.
    TypesWithoutGlossaryEntry,
}

impl Check {
    /// All checks in the order in which they are reported.
    pub const ALL: [Self; 7] = [
        Self::ImportCycles,
        Self::DocComments,
        Self::TypesDefinedTwice,
        Self::SuperlativeConstants,
        Self::FunctionsCalledOf,
        Self::LongTestNames,
        Self::TypesWithoutGlossaryEntry,
    ];

    /// Returns the section's name.
    pub fn section(self) -> &'static str {
        match self {
            Self::ImportCycles => "import-cycles",
            Self::DocComments => "doc-comments-without-subject",
            Self::TypesDefinedTwice => "types-defined-twice",
            Self::SuperlativeConstants => "superlative-constants",
            Self::FunctionsCalledOf => "functions-called-of",
            Self::LongTestNames => "long-test-names",
            Self::TypesWithoutGlossaryEntry => "types-without-glossary-entry",
        }
    }

    /// Returns the limit of a folder that the file of limits does not name.
    pub fn default_limit(self) -> f64 {
        if self == Self::DocComments { SHARE_LIMIT } else { 0.0 }
    }

    /// Returns what the number counts, and how to mend it.
    fn explanation(self) -> &'static str {
        match self {
            Self::ImportCycles => "modules in import cycles; move what both need to a module below them",
            Self::DocComments => "% of the doc comments open without a subject; name the subject or begin with a verb",
            Self::TypesDefinedTwice => {
                "type names with two definitions; rename one, or give the reason in crates/lint/duplicate-names.toml"
            }
            Self::SuperlativeConstants => {
                "constants with superlative names; call them MAX_*, MIN_*, *_TIMEOUT or *_INTERVAL"
            }
            Self::FunctionsCalledOf => "functions called `of`; call them `new`, `from_*` or after what they return",
            Self::LongTestNames => "test names of more than 60 characters; shorten them to a rule",
            Self::TypesWithoutGlossaryEntry => {
                "public types without an entry in docs/glossary.md; explain them there, or give the reason why nobody \
                 needs it in crates/lint/commonplace-types.toml"
            }
        }
    }
}

/// Result of one check in one folder.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// The check that found it.
    pub check: Check,
    /// The folder, or `all`.
    pub folder: String,
    /// The number that is compared with the limit.
    pub count: f64,
    /// Each place with what stands there.
    pub places: Vec<String>,
}

/// Numbers by section and key, as the file of limits has them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LimitTable(BTreeMap<String, BTreeMap<String, f64>>);

/// Names that a check leaves out, each with its reason.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Exemptions {
    /// Type names that may be defined more than once.
    duplicates: BTreeMap<String, String>,
    /// Public types that need no entry in the glossary.
    commonplaces: BTreeMap<String, String>,
}

impl LimitTable {
    /// Parses the file of limits.
    ///
    /// # Errors
    ///
    /// A sentence that names the line which is not `key = number`, or whose section no check has.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut limits = Self::default();
        for entry in entries(text)? {
            if !Check::ALL.iter().any(|check| check.section() == entry.section) {
                return Err(format!("line {}: no check is called [{}]", entry.line, entry.section));
            }
            let number: f64 = entry
                .value
                .parse()
                .map_err(|_| format!("line {}: expected a number, found {}", entry.line, entry.value))?;
            limits.0.entry(entry.section).or_default().insert(entry.key, number);
        }
        Ok(limits)
    }

    fn get(&self, check: Check, folder: &str) -> f64 {
        let limit = self.0.get(check.section()).and_then(|folders| folders.get(folder)).copied();
        limit.unwrap_or(0.0).max(check.default_limit())
    }

    /// Returns these limits lowered to the present numbers. No limit rises, and limits that every folder has are left out.
    pub fn lowered_to(&self, findings: &[Finding]) -> Self {
        let mut limits = Self::default();
        for finding in findings {
            let limit = self.get(finding.check, &finding.folder).min(finding.count);
            if limit > finding.check.default_limit() {
                let section = limits.0.entry(finding.check.section().to_owned()).or_default();
                section.insert(finding.folder.clone(), limit);
            }
        }
        limits
    }
}

impl fmt::Display for LimitTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "# What perturb-lint still tolerates, by check and folder. A folder without a line has the check's own limit: 2 %"
        )?;
        writeln!(
            f,
            "# of the doc comments, and none of all else. Limits only fall: `cargo run --release --package perturb-lint --"
        )?;
        writeln!(f, "# --lower-limits` lowers them to the present numbers.")?;
        for check in Check::ALL {
            let Some(folders) = self.0.get(check.section()) else { continue };
            writeln!(f, "\n[{}]", check.section())?;
            for (folder, limit) in folders {
                writeln!(f, "\"{folder}\" = {limit}")?;
            }
        }
        Ok(())
    }
}

impl Exemptions {
    /// Parses the file of type names that may be defined more than once.
    ///
    /// # Errors
    ///
    /// A sentence that names the line which is not `Name = "reason"`, or whose reason is empty.
    pub fn parse(text: &str) -> Result<Self, String> {
        Ok(Self { duplicates: reasons(text)?, commonplaces: BTreeMap::new() })
    }

    /// Adds the file of public types that need no entry in the glossary.
    ///
    /// # Errors
    ///
    /// Those of [`Exemptions::parse`].
    pub fn with_commonplaces(self, text: &str) -> Result<Self, String> {
        Ok(Self { commonplaces: reasons(text)?, ..self })
    }
}

/// Reads names with their reasons.
fn reasons(text: &str) -> Result<BTreeMap<String, String>, String> {
    let mut reasons = BTreeMap::new();
    for entry in entries(text)? {
        if entry.value.is_empty() {
            return Err(format!("line {}: {} has no reason", entry.line, entry.key));
        }
        reasons.insert(entry.key, entry.value);
    }
    Ok(reasons)
}

struct KeyValue {
    section: String,
    key: String,
    value: String,
    line: usize,
}

/// Reads `key = value` lines with their sections. Quotation marks around keys and values are removed.
fn entries(text: &str) -> Result<Vec<KeyValue>, String> {
    let mut section = String::new();
    let mut entries = Vec::new();
    for (index, line) in text.lines().map(str::trim).enumerate() {
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
            section = name.to_owned();
            continue;
        }
        let Some((key, value)) = line.split_once('=') else {
            return Err(format!("line {}: expected key = value, found {line}", index + 1));
        };
        let [key, value] = [key, value].map(|part| part.trim().trim_matches('"').to_owned());
        entries.push(KeyValue { section: section.clone(), key, value, line: index + 1 });
    }
    Ok(entries)
}

/// Runs all checks.
pub fn check(tree: &SourceTree, exemptions: &Exemptions) -> Vec<Finding> {
    let mut findings = Vec::new();
    for package in imports::read(tree) {
        let cycles = cycles::find(&package);
        let count = cycles.iter().map(|cycle| cycle.modules.len()).sum::<usize>() as f64;
        let places = cycles.iter().map(ToString::to_string).collect();
        findings.push(Finding { check: Check::ImportCycles, folder: package.folder, count, places });
    }
    findings.extend(doc_comment_shares(tree));
    let names = names::read(tree);
    findings.push(types_defined_twice(&names.types, exemptions));
    findings.extend(by_folder(Check::SuperlativeConstants, &names.superlatives));
    findings.extend(by_folder(Check::FunctionsCalledOf, &names.called_of));
    findings.extend(by_folder(Check::LongTestNames, &names.long_tests));
    if let Some(text) = tree.get(GLOSSARY) {
        let is_commonplace = |name: &str| exemptions.commonplaces.contains_key(name);
        let unexplained = glossary::unexplained(&names.public_types, text, is_commonplace);
        findings.extend(by_folder(Check::TypesWithoutGlossaryEntry, unexplained));
    }
    findings
}

fn doc_comment_shares(tree: &SourceTree) -> Vec<Finding> {
    let mut folders: BTreeMap<String, (usize, Vec<String>)> = BTreeMap::new();
    for comment in doc_comments::read(tree) {
        let (count, places) = folders.entry(comment.folder).or_default();
        *count += 1;
        if comment.lacks_subject {
            places.push(format!("{}:{}: {}", comment.file, comment.line, comment.text));
        }
    }
    let share = |places: usize, count: usize| (1000.0 * places as f64 / count as f64).ceil() / 10.0;
    let findings = folders.into_iter().map(|(folder, (count, places))| Finding {
        check: Check::DocComments,
        folder,
        count: share(places.len(), count),
        places,
    });
    findings.collect()
}

fn types_defined_twice(types: &[Definition], exemptions: &Exemptions) -> Finding {
    let twice = names::defined_twice(types);
    let places: Vec<_> = twice
        .iter()
        .filter(|(name, _)| !exemptions.duplicates.contains_key(**name))
        .map(|(name, definitions)| {
            let places: Vec<_> = definitions.iter().map(|place| format!("{}:{}", place.file, place.line)).collect();
            format!("{name}: {}", places.join(", "))
        })
        .collect();
    Finding { check: Check::TypesDefinedTwice, folder: "all".to_owned(), count: places.len() as f64, places }
}

fn by_folder<'a>(check: Check, definitions: impl IntoIterator<Item = &'a Definition>) -> Vec<Finding> {
    let mut folders: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for place in definitions {
        folders
            .entry(folder_of(&place.file))
            .or_default()
            .push(format!("{}:{}: {}", place.file, place.line, place.name));
    }
    let findings = folders.into_iter().map(|(folder, places)| Finding {
        check,
        folder: folder.to_owned(),
        count: places.len() as f64,
        places,
    });
    findings.collect()
}

/// The comparison of findings with limits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verdict {
    /// Messages about findings over their limits.
    pub errors: Vec<String>,
    /// Messages about limits and exemptions that are no longer needed.
    pub warnings: Vec<String>,
}

/// Compares findings with limits, and exemptions with the types that need them.
pub fn judge(tree: &SourceTree, findings: &[Finding], limits: &LimitTable, exemptions: &Exemptions) -> Verdict {
    let mut verdict = Verdict::default();
    for finding in findings {
        let limit = limits.get(finding.check, &finding.folder);
        if finding.count > limit {
            verdict.errors.push(describe(finding, limit));
        }
    }
    let found: BTreeMap<_, _> =
        findings.iter().map(|finding| ((finding.check.section(), finding.folder.as_str()), finding.count)).collect();
    for (section, folders) in &limits.0 {
        for (folder, &limit) in folders {
            let count = found.get(&(section.as_str(), folder.as_str())).copied().unwrap_or(0.0);
            if count < limit {
                verdict
                    .warnings
                    .push(format!("crates/lint/limits.toml: [{section}] \"{folder}\" = {limit} can fall to {count}"));
            }
        }
    }
    let names = names::read(tree);
    let twice: BTreeSet<_> = names::defined_twice(&names.types).into_keys().collect();
    for name in exemptions.duplicates.keys().filter(|name| !twice.contains(name.as_str())) {
        verdict
            .warnings
            .push(format!("crates/lint/duplicate-names.toml: {name} is not defined twice; remove the entry"));
    }
    let types: BTreeSet<_> = names.types.iter().map(|definition| definition.name.as_str()).collect();
    for name in exemptions.commonplaces.keys().filter(|name| !types.contains(name.as_str())) {
        verdict.warnings.push(format!("crates/lint/commonplace-types.toml: there is no type {name}; remove the entry"));
    }
    let explained = tree.get(GLOSSARY).map(glossary::explained_types).unwrap_or_default();
    for name in explained.iter().filter(|name| !types.contains(**name)) {
        verdict.warnings.push(format!("{}: there is no type {name}; remove the entry", GLOSSARY));
    }
    verdict
}

fn describe(finding: &Finding, limit: f64) -> String {
    let mut text = format!("{}: {} {} (limit {limit})", finding.folder, finding.count, finding.check.explanation());
    for place in finding.places.iter().take(MAX_EXAMPLES) {
        let _ = write!(text, "\n  {place}");
    }
    if finding.places.len() > MAX_EXAMPLES {
        let _ = write!(
            text,
            "\n  and {} more: perturb-lint --list {}",
            finding.places.len() - MAX_EXAMPLES,
            finding.folder
        );
    }
    text
}
