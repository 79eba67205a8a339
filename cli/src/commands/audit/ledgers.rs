//! `perturb audit --ledger`: proves with the servers' ledgers that a policy's training drew only from its stated set,
//! and played no test episode. A ledger is a server's log of everything that its sessions drew.

use std::io::Write;
use std::process::ExitCode;

use serde_json::{Value, json};

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_records::Records;
use perturb_records::ledger::{Head, Ledgers, Proof};

use super::super::{args::AuditArgs, display::output, error::CommandError, error::Result, reconnecting_servers};
use super::{RecordedPolicy, server_args};

/// Prints what the ledgers prove about each policy. Returns success if no ledger contradicts a policy.
pub(super) fn prove(args: &AuditArgs, recorded: &[RecordedPolicy]) -> Result<ExitCode> {
    let ledgers = Ledgers::read(&args.ledger, &args.head).map_err(CommandError::Failed)?;
    let servers = reconnecting_servers(&server_args(args)?, args.wait, &StopFlag::default())?;
    let mut proofs = Vec::new();
    let mut out = output();
    // Check that the checkpoint is that of the recorded policy, and compare its training with the ledgers.
    for policy in recorded {
        let name = policy.name.as_str();
        let records = Records::read(&policy.records)?;
        let checkpoint = Checkpoint::load(&policy.checkpoint)?;
        let id = checkpoint.id().map_err(|reason| CommandError::Failed(format!("{name}: {reason}")))?;
        if id != records.about.policy {
            let expected = &records.about.policy;
            let message = format!("{name}: the records are of policy {expected}, but the checkpoint is {id}");
            return Err(CommandError::Usage(message));
        }
        if records.about.tests.is_empty() {
            return Err(CommandError::Failed(format!("{name}: the records have no test, so nothing can be proved")));
        }
        let training = &checkpoint.state.config.common;
        let counters = checkpoint.state.counters;
        let environment = servers.environment(&training.environment)?;
        let episodes = counters.generated_episodes.max(counters.episodes);
        proofs.push((name, ledgers.prove(training, episodes, &environment, &records)));
        if !args.json.is_printed() {
            proofs.last().map_or(Ok(()), |(name, proof)| print(name, proof, &records))?;
        }
    }
    // A policy is clean if no ledger contradicts it.
    let clean = proofs.iter().filter(|(_, proof)| proof.against.is_empty()).count();
    let policies: Vec<Value> = proofs.iter().map(|(name, proof)| document(name, proof)).collect();
    let heads: Vec<Value> = ledgers.heads().iter().map(head).collect();
    args.json.write(json!({ "clean": clean, "policies": policies, "ledgers": heads }))?;
    if !args.json.is_printed() {
        for Head { path, lines, digest, unfinished } in ledgers.heads() {
            let partial =
                if *unfinished > 0 { format!(", and {unfinished} bytes of an unfinished line") } else { String::new() };
            writeln!(out, "{}: {lines} lines{partial}, unbroken up to --head {digest}", path.display())?;
        }
    }
    Ok(if clean == proofs.len() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn print(name: &str, proof: &Proof, records: &Records) -> std::io::Result<()> {
    let mut out = output();
    proof.against.iter().chain(&proof.refused).try_for_each(|line| writeln!(out, "{name}: {line}"))?;
    if !proof.against.is_empty() {
        return Ok(());
    }
    let tokens: Vec<String> = proof
        .tokens
        .iter()
        .map(|token| token.as_ref().map_or("no token".into(), |token| format!("{token:?}")))
        .collect();
    let tokens = tokens.join(" and ");
    let sets: Vec<&str> = records.about.tests.iter().map(|test| test.set.name.as_str()).collect();
    let sessions = if proof.sessions == 1 { "session" } else { "sessions" };
    writeln!(
        out,
        "{name}: the training was drawn with {tokens} in {} {sessions}. Before the training ended, no episode of the \
         tests on {} was played with {tokens}, and none of a test set outside of the training's distribution",
        proof.sessions,
        sets.join(", ")
    )
}

fn document(name: &str, Proof { tokens, sessions, against, refused }: &Proof) -> Value {
    json!({ "policy": name, "tokens": tokens, "sessions": sessions, "against": against, "refused": refused })
}

fn head(Head { path, lines, digest, unfinished }: &Head) -> Value {
    json!({ "ledger": path.to_string_lossy(), "lines": lines, "head": digest, "unfinished_bytes": unfinished })
}
