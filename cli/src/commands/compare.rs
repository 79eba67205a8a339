//! `perturb compare`: compares conditions over their seeds.

mod table;

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};

use perturb_files::interrupt::StopFlag;
use perturb_files::{require_writable, write_atomically};
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::evaluation::{TestOptions, Tester};
use perturb_records::comparison::{ComparedCondition, ComparedScore, compare};
use perturb_records::success::{Criterion, Rule};
use perturb_records::{ExternalEvaluation, FILE, Records};
use perturb_report::{EnvironmentComparison, comparison_page};
use perturb_settings::sets::TestSet;
use perturb_text::Table;
use serde_json::json;

use super::args::CompareArgs;
use super::display::{Display, note, output};
use super::error::{CommandError, Result, system};
use super::{playing_servers, sets};

/// The file name extension of a policy that is stored in a single file.
const POLICY_EXTENSION: &str = "safetensors";

/// A policy of a condition.
enum ComparedPolicy {
    /// A policy whose tests were recorded.
    Recorded(Box<Records>),
    /// A policy that this command tests itself.
    Trained(Box<Checkpoint>),
}

/// A condition's name, and the recorded tests of its policies. Each policy has a key, and policies of two conditions
/// are paired by equal keys.
type TestedPolicies = (String, Vec<(String, Records)>);

/// A condition: its name, and its policies with their keys.
struct NamedPolicies {
    name: String,
    policies: Vec<(String, ComparedPolicy)>,
}

/// A comparison, with the rule of success if it is known.
type ComparisonWithRule = (EnvironmentComparison, Option<String>);

pub(super) fn run(args: &CompareArgs) -> Result<()> {
    args.json.check()?;
    args.html.as_deref().map_or(Ok(()), require_writable)?;
    let score = match args.score.as_str() {
        "return" => ComparedScore::Return,
        "length" => ComparedScore::Length,
        _ => ComparedScore::Success,
    };
    let (of, success) = match table::comparison(args, score)? {
        Some(compared) => compared,
        None => tested_comparison(args, score)?,
    };
    if let Some(path) = &args.html {
        write_atomically(path, comparison_page(&of).as_bytes())?;
    }
    if args.json.json.is_some() {
        let mut document = json!(of.comparison);
        document["environment"] = json!(of.environment);
        document["success"] = json!(success);
        args.json.write(document)?;
    }
    if args.json.is_printed() {
        return Ok(());
    }
    let success = success.map(|rule| format!(", success: {rule}")).unwrap_or_default();
    let mut out = output();
    writeln!(out, "{}{success}", of.environment)?;
    let tables: Vec<String> = of.tables().iter().map(Table::to_text).collect();
    writeln!(out, "{}", tables.join("\n\n"))?;
    Ok(writeln!(out, "\n{}.\n\n{}", of.comparison.verdict, of.note())?)
}

/// Compares policies that are tested now or have recorded episodes.
fn tested_comparison(args: &CompareArgs, score: ComparedScore) -> Result<ComparisonWithRule> {
    let conditions = args.conditions.iter().map(|text| condition(text)).collect::<Result<Vec<_>>>()?;
    let sets = tested_sets(args, &conditions)?;
    let tested = test(args, conditions, &sets)?;
    let compared: Vec<_> = tested.iter().map(by_reference).collect();
    let names: Vec<String> = sets.iter().map(|set| set.name.clone()).collect();
    let comparison = compare(&compared, &names, score, args.baseline.as_deref())?;
    let about = &tested[0].1[0].1.about;
    let success = about.success.as_ref().map(ToString::to_string);
    Ok((EnvironmentComparison { environment: about.environment.clone(), comparison }, success))
}

fn by_reference((name, policies): &TestedPolicies) -> ComparedCondition<'_> {
    let policies = policies.iter().map(|(key, records)| (key.clone(), records));
    ComparedCondition { name: name.clone(), policies: policies.collect() }
}

/// Splits a condition, written `NAME=PATH,PATH` or `PATH,PATH`, into its name, if it has one, and its paths.
fn split(text: &str) -> (Option<&str>, Vec<PathBuf>) {
    let (name, paths) = match text.split_once('=') {
        Some((name, paths)) if !name.is_empty() && !name.contains(['/', ',']) => (Some(name), paths),
        _ => (None, text),
    };
    (name, paths.split(',').map(PathBuf::from).collect())
}

/// Returns the name of a condition to which the user gave no name. It is the name of the condition's first path.
fn default_name(paths: &[PathBuf]) -> String {
    paths[0].file_stem().unwrap_or(paths[0].as_os_str()).to_string_lossy().into_owned()
}

/// Reads the policies of a condition.
fn condition(text: &str) -> Result<NamedPolicies> {
    let (name, paths) = split(text);
    let name = name.map_or_else(|| default_name(&paths), str::to_owned);
    let mut policies = Vec::new();
    for path in &paths {
        policies.extend(policies_at(path)?);
    }
    let seeds: BTreeSet<String> = policies.iter().filter_map(seed).collect();
    // If each policy has its own seed, the seeds are the policies' keys. Otherwise the keys are 1, 2, 3 and so on.
    let seeds_are_keys = seeds.len() == policies.len();
    let key = |place: usize, policy: &ComparedPolicy| {
        seed(policy).filter(|_| seeds_are_keys).unwrap_or_else(|| (place + 1).to_string())
    };
    let policies = policies.into_iter().enumerate().map(|(place, policy)| (key(place, &policy), policy));
    Ok(NamedPolicies { policies: policies.collect(), name })
}

/// Returns the seed of a policy's training. Returns `None` for recorded tests, which do not have it.
fn seed(policy: &ComparedPolicy) -> Option<String> {
    match policy {
        ComparedPolicy::Trained(checkpoint) => Some(checkpoint.state.config.common.seed.to_string()),
        ComparedPolicy::Recorded(_) => None,
    }
}

/// Loads the policy at `path`. If there is none, loads the policies in the folder `path`, in the order of their names.
fn policies_at(path: &Path) -> Result<Vec<ComparedPolicy>> {
    let error = match policy_at(path) {
        Ok(policy) => return Ok(vec![policy]),
        Err(error) => error,
    };
    let below: Vec<ComparedPolicy> = match path.is_dir() {
        true => perturb_files::list(path)?.iter().filter_map(|below| policy_at(below).ok()).collect(),
        false => Vec::new(),
    };
    if below.is_empty() { Err(error) } else { Ok(below) }
}

fn policy_at(path: &Path) -> Result<ComparedPolicy> {
    if ExternalEvaluation::is_in(path) {
        let evaluation = ExternalEvaluation::read(path)?;
        let [policy] = evaluation.policies() else {
            let count = evaluation.policies().len();
            let message =
                format!("{} holds tests of {count} policies; save the tests of each policy separately", path.display());
            return Err(CommandError::Usage(message));
        };
        return Ok(ComparedPolicy::Recorded(Box::new(policy.records.clone())));
    }
    let is_policy = path.extension().is_some_and(|extension| extension == POLICY_EXTENSION);
    if !is_policy && (path.is_file() || path.join(FILE).is_file()) {
        let records = Records::read(&super::rescore::records_file(path))?;
        return Ok(ComparedPolicy::Recorded(Box::new(records)));
    }
    Ok(ComparedPolicy::Trained(Box::new(Checkpoint::load(path)?)))
}

/// Returns the sets to compare on: those of the arguments, or else the sets that all recorded tests have in common.
/// Without recorded tests, the default is D, R and E.
fn tested_sets(args: &CompareArgs, conditions: &[NamedPolicies]) -> Result<Vec<TestSet>> {
    let is_given = !args.versions.is_empty() || !args.set.parameters.is_empty() || args.set.contexts.is_some();
    let policies = conditions.iter().flat_map(|condition| &condition.policies);
    let recorded: Vec<&Records> = policies
        .filter_map(|(_, policy)| match policy {
            ComparedPolicy::Recorded(records) => Some(&**records),
            ComparedPolicy::Trained(_) => None,
        })
        .collect();
    let Some(first) = recorded.first().filter(|_| !is_given) else {
        return sets::test_sets(&args.versions, &args.set);
    };
    let has = |records: &Records, set: &TestSet| records.about.tests.iter().any(|test| test.set.name == set.name);
    let common: Vec<TestSet> = first
        .about
        .tests
        .iter()
        .map(|test| test.set.clone())
        .filter(|set| recorded.iter().all(|records| has(records, set)))
        .collect();
    if common.is_empty() {
        return Err(CommandError::Usage(
            "the recorded tests have no set in common; test all on the same versions".into(),
        ));
    }
    Ok(common)
}

/// Tests the policies without recorded tests, and judges all episodes by the success rule of --success.
fn test(args: &CompareArgs, conditions: Vec<NamedPolicies>, sets: &[TestSet]) -> Result<Vec<TestedPolicies>> {
    let policies = || conditions.iter().flat_map(|condition| &condition.policies);
    let plays = policies().any(|(_, policy)| matches!(policy, ComparedPolicy::Trained(_)));
    if plays && policies().any(|(_, policy)| matches!(policy, ComparedPolicy::Recorded(_))) {
        note("recorded tests are compared with tests that run now: their episodes may differ");
    }
    let stop = StopFlag::on_signals().map_err(system("wait for signals"))?;
    let servers = plays.then(|| playing_servers(&args.play, &stop)).transpose()?;
    let mut tested = Vec::new();
    for NamedPolicies { name, policies } in conditions {
        let mut records = Vec::new();
        for (key, policy) in policies {
            let found = match (policy, &servers) {
                (ComparedPolicy::Trained(checkpoint), Some(servers)) => {
                    let environment = servers.environment(&checkpoint.state.config.common.environment)?;
                    let text = Criterion::from_environment(&environment);
                    let code = Criterion::from_environment_code(&environment);
                    let rule = |rule| sets::normalize_rule(rule, text.as_ref(), code.as_ref());
                    let success = args.success.as_ref().map(rule).transpose()?;
                    let normalize = |set: &TestSet| sets::normalize_set(set.clone(), &environment);
                    let sets = sets.iter().map(normalize).collect::<Result<Vec<_>, _>>()?;
                    let options = TestOptions { episodes: args.episodes, seed: args.seed, selects: false, success };
                    let tester = Tester::new(servers, &checkpoint, options)?;
                    let mut display: Option<(String, Display)> = None;
                    let mut report = |set: &TestSet, episodes| {
                        if display.as_ref().is_none_or(|(shown, _)| *shown != set.name) {
                            let what = format!("testing {name}, seed {key}, on {}", set.name);
                            display = Some((set.name.clone(), Display::for_episodes(what, args.episodes)));
                        }
                        if let Some((_, display)) = &mut display {
                            display.episodes(episodes);
                        }
                    };
                    tester.test(&sets, &stop, &mut report)?
                }
                (ComparedPolicy::Recorded(records), _) => judged(*records, args.success.as_ref())?,
                (ComparedPolicy::Trained(_), None) => continue,
            };
            records.push((key, found));
        }
        tested.push((name, records));
    }
    Ok(tested)
}

fn judged(records: Records, rule: Option<&Rule>) -> Result<Records> {
    let Some(rule) = rule else { return Ok(records) };
    let about = &records.about;
    let text = about.text_success.as_ref().or(about.success.as_ref());
    let rule = sets::normalize_rule(rule, text, about.code_success.as_ref())?;
    Ok(records.judged_by(&rule)?)
}
