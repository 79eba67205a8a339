//! What an environment costs in memory.

use perturb_mujoco::{Model, Simulation};
use std::{env, fs, process::Command};

/// Set in the process that measures: one of its own, so that no other test's memory counts.
const MEASURING: &str = "PERTURB_TEST_MEMORY";

fn resident_kb() -> f64 {
    let status = fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

#[test]
fn a_hopper_with_a_model_of_its_own_takes_at_most_150_kb() {
    if env::var_os(MEASURING).is_none() {
        let mut alone = Command::new(env::current_exe().unwrap());
        alone.args(["--exact", "memory::a_hopper_with_a_model_of_its_own_takes_at_most_150_kb"]);
        let output = alone.env(MEASURING, "1").output().unwrap();
        let printed = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && printed.contains("1 passed"), "{printed}");
        return;
    }
    const N: usize = 2000;
    let model = Model::from_xml(include_str!("../../../../models/hopper.xml")).unwrap();
    let before = resident_kb();
    let mut simulations = Vec::with_capacity(N);
    for _ in 0..N {
        let mut simulation = Simulation::new(model.try_clone().unwrap()).unwrap();
        simulation.set_const().unwrap();
        simulation.reset().unwrap();
        // Long enough to fall: constraints touch most of the memory.
        for _ in 0..200 {
            simulation.step1().unwrap();
            simulation.step2().unwrap();
        }
        simulations.push(simulation);
    }
    let each = (resident_kb() - before) / N as f64;
    println!("{each:.0} kB");
    assert!(each <= 150.0, "{each} kB");
}
