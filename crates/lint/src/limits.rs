//! The limits of every check by folder, and the names that are exempt from a check.
//!
//! The files with limits and exemptions use a small part of TOML: `[section]`, `key = value`, and comments on separate
//! lines.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Write as _};

use crate::cycles;
use crate::doc_comments;
use crate::glossary;
use crate::imports;
use crate::names::{self, Definition};
use crate::source::{GLOSSARY, SourceTree, folder_of};

/// The default limit for the share of doc comments without a subject in a folder, in percent.
pub const SHARE_LIMIT: f64 = 2.0;

/// Maximum number of findings that a failed check prints for each folder.
const MAX_EXAMPLES: usize = 10;

/// A check. Each has its own section in the file of limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Check {
    /// The number of modules in import cycles, by package.
    ImportCycles,
    /// The share of doc comments that open without a subject, in percent, by folder.
    DocComments,
    /// The number of type names that more than one file of the repository defines, without the exempt names.
    TypesDefinedTwice,
    /// The number of constants with superlative names, by folder.
    SuperlativeConstants,
    /// The number of functions called `of`, by folder.
    FunctionsCalledOf,
    /// The number of tests whose names have more than 60 characters, by folder.
    LongTestNames,
    /// The number of public types that the glossary does not explain, by folder.
    TypesWithoutGlossaryEntry,
}

impl Check {
    /// All checks, in the order in which they are reported.
    pub const ALL: [Self; 7] = [
        Self::ImportCycles,
        Self::DocComments,
        Self::TypesDefinedTwice,
        Self::SuperlativeConstants,
        Self::FunctionsCalledOf,
        Self::LongTestNames,
        Self::TypesWithoutGlossaryEntry,
    ];

    /// Returns the name of the check's section in the file of limits.
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

    /// Returns the limit of folders that are not in the file of limits.
    pub fn default_limit(self) -> f64 {
        if self == Self::DocComments { SHARE_LIMIT } else { 0.0 }
    }

    /// Describes the counted findings and how to remove them, for error messages.
    fn explanation(self) -> &'static str {
        match self {
            Self::ImportCycles => {
                "modules in import cycles; move the code that they share to a module that imports none of them"
            }
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

/// The result of one check in one folder, which is compared with a limit.
#[derive(Clone, Debug, PartialEq)]
pub struct Finding {
    /// The check.
    pub check: Check,
    /// The folder, or `all` for the whole repository.
    pub folder: String,
    /// The number that is compared with the limit.
    pub count: f64,
    /// The findings, each with its location.
    pub places: Vec<String>,
}

/// Limits by section and folder, as in the file of limits.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LimitTable(BTreeMap<String, BTreeMap<String, f64>>);

/// Names that are exempt from a check, each with a reason.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Exemptions {
    /// Type names that may have several definitions, with reasons.
    duplicates: BTreeMap<String, String>,
    /// Public types that need no entry in the glossary, with reasons.
    commonplaces: BTreeMap<String, String>,
}

impl LimitTable {
    /// Parses the file of limits.
    ///
    /// # Errors
    ///
    /// An error message with the number of the line that is not `key = number`, or whose section belongs to no check.
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

    /// Returns the limits with each reduced to the current number of findings, if this number is smaller. No limit
    /// rises. Omits limits that equal the default.
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
    /// Parses the file of type names that may have several definitions.
    ///
    /// # Errors
    ///
    /// An error message with the number of the line that is not `Name = "reason"`, or whose reason is empty.
    pub fn parse(text: &str) -> Result<Self, String> {
        Ok(Self { duplicates: reasons(text)?, commonplaces: BTreeMap::new() })
    }

    /// Adds the names in the file of public types that need no entry in the glossary.
    ///
    /// # Errors
    ///
    /// The errors of [`Exemptions::parse`].
    pub fn with_commonplaces(self, text: &str) -> Result<Self, String> {
        Ok(Self { commonplaces: reasons(text)?, ..self })
    }
}

/// Parses names with their reasons.
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

/// Parses lines `key = value`, and stores the section of each line. Removes quotation marks around keys and values.
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

/// Runs all checks on the source files.
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

/// The result of comparing findings with limits.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verdict {
    /// Error messages for findings that exceed their limits.
    pub errors: Vec<String>,
    /// Warnings for limits and exemptions that are no longer needed.
    pub warnings: Vec<String>,
}

/// Compares findings with limits, and looks for exemptions that are no longer needed.
pub fn judge(tree: &SourceTree, findings: &[Finding], limits: &LimitTable, exemptions: &Exemptions) -> Verdict {
    let mut verdict = Verdict::default();
    for finding in findings {
        let limit = limits.get(finding.check, &finding.folder);
        if finding.count > limit {
            verdict.errors.push(describe(finding, limit));
        }
    }
    // Adds a warning for each limit that is above the number of findings.
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
    // Adds a warning for each exemption or glossary entry whose type no longer exists, and for each exemption of a type
    // that is no longer defined twice.
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
