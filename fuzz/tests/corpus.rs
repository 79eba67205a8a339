//! Runs every fuzz target for some seconds: on the valid inputs, on the corpus, and on random mutations of both. The
//! seeds of the mutations are printed.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::sync::{Mutex, Once, PoisonError};
use std::time::Instant;

use perturb_fuzz::{FuzzTarget, TARGETS, replies, seeds};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// The default number of mutated inputs for each target. The environment variable `PERTURB_FUZZ_INPUTS` changes it.
const DEFAULT_INPUTS: u64 = 200;
/// The environment variable with the maximum growth of memory after the first tenth of the inputs, in MB. The limit is
/// only meaningful in a process that runs no other tests, as in `make attack-test`.
const MAX_GROWTH_VARIABLE: &str = "PERTURB_FUZZ_MOST_GROWN_MB";

/// The seed of each target's current input.
static SEEDS: Mutex<BTreeMap<String, u64>> = Mutex::new(BTreeMap::new());

fn attack(name: &str) {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        // Aborts the process at any panic, because a panic in a server thread would end only that thread. Writes to
        // stderr directly, because a test's captured output is lost in an abort.
        std::panic::set_hook(Box::new(|panic| {
            let seeds = SEEDS.lock().unwrap_or_else(PoisonError::into_inner);
            let again = "each is repeated by PERTURB_FUZZ_SEED=SEED PERTURB_FUZZ_INPUTS=1";
            let _ = writeln!(std::io::stderr(), "{panic}\nseeds under way: {seeds:?}; {again}");
            std::process::abort();
        }));
    });
    let FuzzTarget { run, .. } = TARGETS.iter().find(|target| target.name == name).expect("a target");
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(name);
    let mut found: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|file| file.path()).collect();
    found.sort();
    let found = found.iter().map(|path| std::fs::read(path).expect("a file"));
    let inputs: Vec<Vec<u8>> = seeds(name).into_iter().chain(found).collect();
    assert!(!inputs.is_empty());
    inputs.iter().for_each(|input| run(input));
    let number = |name: &str, default| std::env::var(name).map_or(default, |text| text.parse().expect("a number"));
    let count = number("PERTURB_FUZZ_INPUTS", DEFAULT_INPUTS);
    let first = number("PERTURB_FUZZ_SEED", 1);
    let start = Instant::now();
    let mut at_first = 0;
    let tenth = (count / 10).max(1);
    for seed in first..first + count {
        if seed == first + tenth {
            at_first = memory();
        }
        if count > DEFAULT_INPUTS && (seed - first).is_multiple_of(tenth) {
            eprintln!("{name}: {} of {count} inputs in {:.0?}", seed - first, start.elapsed());
        }
        SEEDS.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned(), seed);
        run(&mutated(&inputs, &mut ChaCha8Rng::seed_from_u64(seed)));
    }
    let limit = number(MAX_GROWTH_VARIABLE, u64::MAX).saturating_mul(1_000_000);
    let growth = memory().saturating_sub(at_first);
    println!("{name}: {count} inputs in {:.0?}, {} kB more since the first tenth", start.elapsed(), growth >> 10);
    assert!(growth < limit, "{name}: memory grew by {growth} bytes");
}

/// Returns the resident memory of this process, in bytes.
fn memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("Linux");
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("a size");
    line.trim_end_matches("kB").trim().parse::<u64>().expect("kB") << 10
}

/// Returns a copy of one of the inputs with a few random changes.
fn mutated(inputs: &[Vec<u8>], random: &mut ChaCha8Rng) -> Vec<u8> {
    let below = |random: &mut ChaCha8Rng, end: usize| random.next_u64() as usize % end.max(1);
    let mut input = inputs[below(random, inputs.len())].clone();
    for _ in 0..=below(random, 4) {
        let at = below(random, input.len());
        let length = below(random, 16);
        let end = (at + length).min(input.len());
        match below(random, 6) {
            0 => input.truncate(at),
            1 => drop(input.drain(at..end)),
            2 => {
                let part = input[at..end].to_vec();
                input.splice(at..at, part.repeat(below(random, 8)));
            }
            3 => {
                let other = &inputs[below(random, inputs.len())];
                input.splice(at.., other[below(random, other.len())..].to_vec());
            }
            4 => input[at..end].fill([0, 0x7F, 0x80, 0xFF][below(random, 4)]),
            _ if at < input.len() => input[at] ^= 1 << below(random, 8),
            _ => {}
        }
    }
    input
}

/// Checks that the server accepts the valid inputs. Mutations of an input that the server rejects at once would test
/// little.
#[test]
fn seeds_of_sessions_are_answered_without_a_refusal() {
    for seed in seeds("requests") {
        let (number, mut refused) = replies(&seed);
        refused.retain(|refusal| !refusal.contains("OpenGL")); // not every machine has OpenGL
        assert!(number > 2 && refused.is_empty(), "{number} replies, {refused:?}");
    }
}

#[test]
fn requests() {
    attack("requests");
}

#[test]
fn snapshots() {
    attack("snapshots");
}

#[test]
fn worlds() {
    attack("worlds");
}

#[test]
fn connections() {
    attack("connections");
}

#[test]
fn checkpoints() {
    attack("checkpoints");
}

#[test]
fn records() {
    attack("records");
}

#[test]
fn plans() {
    attack("plans");
}

#[test]
fn ledgers() {
    attack("ledgers");
}

#[test]
fn tasks() {
    attack("tasks");
}

#[test]
fn models() {
    attack("models");
}
