//! The learner against real servers.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use perturb_files::interrupt::StopFlag;
use perturb_learner::checkpoint::Checkpoint;
use perturb_learner::client::{Address, ClientSession, OpenOptions, PrivateServer, Servers, StepReply};
use perturb_learner::evaluation::test;
use perturb_learner::policy::TrainablePolicy;
use perturb_learner::rollout::{Collector, Normalisers, RolloutBuffer};
use perturb_policy::{ActionKind, CollectUntil, Inputs, Player, PlayerRole, PolicySpec};
use perturb_protocol::Version;
use perturb_torch::{Sequences, TorchPolicy};

use crate::common::{
    addresses, child_server, config, ended, is_running, kill, perturb, read, run, server, stderr, wait_for,
    wait_for_server,
};
use rstest::rstest;
use tch::Tensor;

/// Longest time that a training may continue without its server.
const SOON: Duration = Duration::from_secs(20);

#[test]
fn both_algorithms_train_save_and_test() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    for algorithm in ["ppo", "a2c"] {
        let text = format!(
            "environment = 'CartPole'\nversion = 'R'\nalgorithm = '{algorithm}'\nepisodes = 50\nnum_envs = 4\nlog_interval = 1\n"
        );
        let (out, outcome) = run(&servers, &text);
        assert!(outcome.progress.episodes >= 50, "{algorithm}");
        assert_eq!(outcome.signal, None);

        let monitor = read(out.path(), "monitor.csv");
        let lines: Vec<Vec<f64>> = monitor
            .lines()
            .skip(2)
            .map(|line| line.split(',').map(|field| field.parse().expect("a number")).collect())
            .collect();
        assert_eq!(lines.len() as u64, outcome.progress.episodes);
        let columns = "r,l,t,success,terminated,episode_index,environment_index,trial_index,episode_in_trial,force,\
                       length,mass,applied_force,applied_length,applied_mass,applied_total_mass,applied_pole_mass_length";
        assert_eq!(monitor.lines().nth(1), Some(columns));
        for line in &lines {
            assert_eq!(line[9..12], line[12..15], "what was requested was applied");
            assert_eq!(line[0], line[1], "CartPole pays 1 a step");
            assert!((5.0..=15.0).contains(&line[9]) && (0.25..=0.75).contains(&line[10]), "R's intervals");
        }
        let progress = read(out.path(), "progress.csv");
        assert_eq!(progress.lines().count() as u64, 1 + outcome.progress.iterations);
        assert_eq!(config(&read(out.path(), "config.toml")), config(&text), "the run can be repeated");

        let checkpoint = Checkpoint::load(out.path()).expect("a checkpoint");
        assert_eq!(checkpoint, outcome.checkpoint);
        let result = test(&servers, &checkpoint, Version::D, 30, 1, &StopFlag::default(), |_| {}).expect("a test");
        assert_eq!(result.episodes, 30);
        assert_eq!(result.mean_return, result.mean_length);
        assert!((8.0..=200.0).contains(&result.mean_length), "{}", result.mean_length);
    }
}

#[test]
fn continuous_actions_are_learned_from() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let (_out, outcome) = run(&servers, "environment = 'Pendulum'\nepisodes = 8\nn_steps = 64");
    assert!(outcome.progress.update.std.is_some_and(|std| std != 1.0), "the standard deviation moved");
    let test = |episodes| test(&servers, &outcome.checkpoint, Version::E, episodes, 1, &StopFlag::default(), |_| {});
    assert_eq!(test(4).expect("a test").mean_length, 200.0);
}

#[test]
fn equal_seeds_give_equal_weights_on_any_servers() {
    let text = "environment = 'CartPole'\nversion = 'E'\nepisodes = 40\nnum_envs = 5\nn_steps = 32";
    let train_on = |servers: &[PrivateServer], text: &str| {
        let servers = Servers::connect(&addresses(servers)).expect("connections");
        run(&servers, text).1.checkpoint
    };
    let reference = train_on(&[server(1)], text);
    assert_eq!(train_on(&[server(2)], text), reference, "two workers");
    assert_eq!(train_on(&[server(1), server(2)], text), reference, "two servers");
    let many: Vec<PrivateServer> = (0..7).map(|_| server(1)).collect();
    assert_eq!(train_on(&many, text), reference, "more servers than environments");
    let other = train_on(&[server(1)], &format!("{text}\nseed = 2"));
    assert_ne!(other.weights, reference.weights, "another seed");
}

#[test]
fn recurrent_policies_are_equal_on_one_and_two_servers() {
    let both = [server(1), server(2)];
    let one = Servers::connect(&addresses(&both[..1])).expect("a connection");
    let two = Servers::connect(&addresses(&both)).expect("connections");
    for settings in
        ["algorithm = 'a2c'\nn_steps = 7", "algorithm = 'ppo'\nn_steps = 40\nn_epochs = 2\nn_minibatches = 3"]
    {
        let text = format!(
            "environment = 'CartPole'\narchitecture = 'rc'\nversion = 'R'\nepisodes = 12\nnum_envs = 3\n{settings}"
        );
        let (out, outcome) = run(&one, &text);
        assert!(outcome.progress.episodes >= 12);
        let checkpoint = Checkpoint::load(out.path()).expect("a checkpoint");
        assert_eq!(checkpoint, outcome.checkpoint);
        assert_eq!(checkpoint.policy.lstm, Some(256));
        assert_eq!(run(&two, &text).1.checkpoint, checkpoint, "{settings}");
        let figures = |servers: &Servers| {
            test(servers, &checkpoint, Version::E, 10, 1, &StopFlag::default(), |_| {}).expect("a test")
        };
        assert_eq!(figures(&one), figures(&two));
    }
}

const N_ENVS: usize = 2;
const N_STEPS: usize = 150;

fn pendulums() -> OpenOptions {
    OpenOptions {
        environment: "Pendulum".into(),
        version: Version::R,
        parameters: Default::default(),
        contexts: Vec::new(),
        num_envs: N_ENVS,
        seed: 3,
        episodes_per_trial: 1,
        observe: Default::default(),
    }
}

/// Collects two rollouts of 150 steps. An episode of Pendulum has 200 steps, so the second rollout begins in the middle
/// of an episode and contains the end of it.
fn two_rollouts(servers: &Servers) -> (TrainablePolicy, [RolloutBuffer; 2]) {
    let mut observations = Vec::new();
    let mut session = ClientSession::open(servers, &pendulums(), &mut observations).expect("a session");
    let size = session.observation_size();
    let action = ActionKind::Continuous { size: 1 };
    let spec = PolicySpec { observation_size: size, action, hidden: vec![16], lstm: Some(8) };
    let policy = TrainablePolicy::new(spec.clone(), 1).expect("a policy");
    let inputs = Inputs::new(size, action, N_ENVS, false);
    let mut player = Player::new(&spec, inputs, N_ENVS, 1, Normalisers::default(), PlayerRole::training(1));
    player.begin(&observations, None).expect("observations");
    let mut collector = Collector::new(player);
    let rollouts = [(); 2].map(|()| {
        let mut rollout = RolloutBuffer::new(N_STEPS, N_ENVS, size, 1);
        let steps = CollectUntil::Steps(N_STEPS);
        collector.collect(&mut session, policy.flat_weights(), steps, &mut rollout, |_| {}).expect("a rollout");
        rollout
    });
    (policy, rollouts)
}

#[test]
fn rollouts_keep_what_a_recurrent_policy_remembers() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let (_, [first, second]) = two_rollouts(&servers);
    assert_eq!(first.memory(), vec![0.0; N_ENVS * 16]);
    assert!(second.memory().iter().all(|&x| x != 0.0), "the episodes go on");
    let starts: Vec<usize> = second.starts().iter().enumerate().filter(|(_, start)| **start).map(|(i, _)| i).collect();
    assert_eq!(starts, [100, 101], "after 200 steps");
    let last_values = first.trajectories().expect("a finished rollout").last_values;
    assert_eq!(last_values, &second.values()[..N_ENVS], "computing the last values does not advance the memory");
}

/// libtorch evaluates each rollout from the memory that the policy had at its start, and resets the memory after the
/// end of an episode.
#[test]
fn libtorch_sees_the_values_that_a_recurrent_policy_saw() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let (policy, rollouts) = two_rollouts(&servers);
    let spec = policy.spec();
    let values = |n_steps: usize, observations: &[f32], starts: &[bool], memory: &[f32]| {
        let sequences = Sequences::new(spec, n_steps, observations, starts, memory).expect("shapes that fit");
        let torch = TorchPolicy::new(spec, policy.flat_weights()).expect("a policy");
        Vec::<f32>::from(torch.evaluate(&sequences, &Tensor::of_slice(&vec![0.0f32; starts.len()])).values)
    };
    // The tolerance is for values of order 1, as in learner/tests/learner/gradients.rs.
    let close = |got: &[f32], expected: &[f32]| {
        got.len() == expected.len() && got.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-5)
    };
    for rollout in &rollouts {
        let expected = values(N_STEPS, rollout.observations(), rollout.starts(), rollout.memory());
        assert!(close(rollout.values(), &expected));
    }

    let mut replayed = ClientSession::open(&servers, &pendulums(), &mut Vec::new()).expect("a session");
    let mut reply = StepReply::default();
    let actions: Vec<f32> = rollouts.iter().flat_map(|rollout| rollout.actions().to_vec()).collect();
    for actions in actions.chunks(N_ENVS).take(200) {
        let bytes: Vec<u8> = actions.iter().flat_map(|action| action.to_le_bytes()).collect();
        replayed.step(&bytes, &mut reply).expect("a step");
    }
    let observations: Vec<f32> = rollouts.iter().flat_map(|rollout| rollout.observations().to_vec()).collect();
    let mut episode = observations[..200 * N_ENVS * spec.observation_size].to_vec();
    episode.extend(&reply.final_observations);
    let expected = values(201, &episode, &[false; 201 * N_ENVS], &[0.0; N_ENVS * 16]);
    let got = rollouts[1].trajectories().expect("a finished rollout").truncation_values;
    assert!(close(&got[49 * N_ENVS..50 * N_ENVS], &expected[200 * N_ENVS..]), "{got:?}");
}

/// The policy is an LSTM with one cell that counts steps. It pushes to the left in the first five steps, and then to
/// the right until the pole falls. If it still remembered the previous episode, it would push to the right from the
/// first step, and the episode would be shorter.
#[test]
fn every_test_episode_begins_without_memories() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let (_out, outcome) = run(&servers, "environment = 'CartPole'\nepisodes = 1\nnormalize_observations = false");
    let mut checkpoint = outcome.checkpoint;
    let action = checkpoint.policy.action;
    let spec = PolicySpec { observation_size: 4, action, hidden: vec![], lstm: Some(1) };
    let mut weights = TrainablePolicy::new(spec.clone(), 1).expect("a policy").weights();
    for array in &mut weights {
        array.data = match array.name.as_str() {
            "lstm.bias" => vec![20.0, 20.0, 0.1, 20.0], // the gates are open: a step adds tanh 0.1 to the cell
            "policy.weight" => vec![0.0, 1e4],
            "policy.bias" => vec![0.0, -1e4 * 0.55f32.tanh()],
            _ => vec![0.0; array.data.len()],
        };
    }
    checkpoint.policy = spec;
    checkpoint.weights = weights;
    let length = |episodes| {
        let result = test(&servers, &checkpoint, Version::D, episodes, 1, &StopFlag::default(), |_| {});
        result.expect("a test").mean_length
    };
    let first_episodes = length(100);
    let ten_of_each = length(1000);
    // A test plays in at most 100 environments, so 100 episodes are the first of each, and 1000 are ten of each. Random
    // initial states change the length of an episode by about 1 step, and a mean of 100 lengths by about 0.1.
    assert!((first_episodes - ten_of_each).abs() < 0.5, "{first_episodes} {ten_of_each}");
}

#[test]
fn test_results_depend_on_the_seed_but_not_on_servers() {
    let both = [server(1), server(1)];
    let one = Servers::connect(&addresses(&both[..1])).expect("a connection");
    let two = Servers::connect(&addresses(&both)).expect("connections");
    let (_out, outcome) = run(&one, "environment = 'CartPole'\nepisodes = 20");
    let figures = |servers: &Servers, seed| {
        test(servers, &outcome.checkpoint, Version::E, 150, seed, &StopFlag::default(), |_| {}).expect("a test")
    };
    assert_eq!(figures(&one, 1), figures(&two, 1));
    assert_ne!(figures(&one, 1), figures(&one, 2));
}

#[test]
fn a_refused_request_keeps_the_session_open() {
    let server = [server(1)];
    let servers = Servers::connect(&addresses(&server)).expect("a connection");
    let options = OpenOptions {
        environment: "CartPole".into(),
        version: Version::D,
        parameters: Default::default(),
        contexts: Vec::new(),
        num_envs: 2,
        seed: 1,
        episodes_per_trial: 1,
        observe: Default::default(),
    };
    let mut observations = Vec::new();
    let mut session = ClientSession::open(&servers, &options, &mut observations).expect("a session");
    let mut reply = StepReply::default();
    let error = session.step(&[9, 0, 0, 0, 0, 0, 0, 0], &mut reply).expect_err("there is no action 9").to_string();
    assert!(error.contains("refused a step") && error.contains('9'), "{error}");
    session.step(&[1, 0, 0, 0, 0, 0, 0, 0], &mut reply).expect("a step");
    assert_eq!(reply.rewards, [1.0, 1.0]);
    session.reset(0..2, &mut observations).expect("a reset");
    assert!(observations.iter().all(|x| x.abs() <= 0.05), "CartPole starts near 0");

    let wrong = OpenOptions { environment: "CartPool".into(), ..options };
    let error = ClientSession::open(&servers, &wrong, &mut observations).expect_err("no such environment").to_string();
    assert!(error.contains("CartPool"), "{error}");
}

#[test]
fn a_killed_server_ends_the_training_with_a_checkpoint() {
    let out = tempfile::tempdir().expect("a directory");
    let path = out.path().to_str().expect("a path");
    let arguments = ["train", "--env", "CartPole", "--episodes", "1000000", "--out", path, "--server-wait", "0"];
    let child = perturb(&arguments).spawn().expect("perturb");
    wait_for("a few iterations", || {
        out.path().join("progress.csv").exists() && read(out.path(), "progress.csv").lines().count() > 4
    });
    let server = child_server(child.id()).expect("a private server");
    let killed = Instant::now();
    kill("-KILL", server);
    let output = ended(child);
    assert!(killed.elapsed() < SOON, "{:?}", killed.elapsed());
    assert_eq!(output.status.code(), Some(1));
    let message = stderr(&output);
    assert!(message.contains("lost the server at unix:") && message.contains("signal: 9"), "{message}");
    let episodes = Checkpoint::load(out.path()).expect("a whole checkpoint").state.counters.episodes;
    let kept = format!(
        "the checkpoint after {episodes} episodes is kept in {path}; to go on with the training: perturb train"
    );
    assert!(message.contains(&kept), "{message}");
}

#[rstest]
#[case::interrupt("-INT", 130)]
#[case::terminate("-TERM", 143)]
fn a_signal_ends_a_training_after_its_iteration(#[case] signal: &str, #[case] status: i32) {
    let out = tempfile::tempdir().expect("a directory");
    let path = out.path().to_str().expect("a path");
    let arguments = ["train", "--env", "CartPole", "--episodes", "1000000", "--out", path];
    let child = perturb(&arguments).spawn().expect("perturb");
    wait_for("a checkpoint", || out.path().join("checkpoint/checkpoint.json").exists());
    let server = child_server(child.id()).expect("a private server");
    kill(signal, child.id());
    let output = ended(child);
    assert_eq!(output.status.code(), Some(status), "{}", stderr(&output));
    assert!(stderr(&output).contains("stopped by signal"), "{}", stderr(&output));
    assert!(stderr(&output).contains(&format!("perturb train --resume {path}")), "{}", stderr(&output));
    assert!(!is_running(server));
    let episodes = Checkpoint::load(out.path()).expect("a whole checkpoint").state.counters.episodes;
    assert_eq!(read(out.path(), "monitor.csv").lines().count() as u64, 2 + episodes);
}

#[test]
fn the_program_trains_and_tests() {
    let out = tempfile::tempdir().expect("a directory");
    let run = out.path().join("run");
    let run = run.to_str().expect("a path");
    let json: PathBuf = out.path().join("result.json");
    let json = json.to_str().expect("a path");
    for arguments in [
        &["train", "--env", "CartPole", "--episodes", "20", "--out", run][..],
        &["evaluate", "--checkpoint", run, "--versions", "D,E", "--episodes", "20", "--json", json],
    ] {
        let output = perturb(arguments).output().expect("perturb runs");
        assert!(output.status.success(), "{}", stderr(&output));
    }
    let value: serde_json::Value = serde_json::from_str(&read(out.path(), "result.json")).expect("JSON");
    for (key, expected) in [
        ("environment", serde_json::json!("CartPole")),
        ("algorithm", "ppo".into()),
        ("architecture", "ff".into()),
        ("train_version", "D".into()),
        ("seed", 1.into()),
    ] {
        assert_eq!(value[key], expected);
    }
    let results = value["results"].as_object().expect("results");
    assert_eq!(results.keys().collect::<Vec<_>>(), ["D", "E"]);
    assert_eq!(results["E"]["episodes"], 20);
    for key in ["success_percent", "mean_return", "mean_length"] {
        assert!(results["D"][key].is_number(), "{key}");
    }
}

#[test]
fn the_program_prints_the_catalogue() {
    let output = perturb(&["envs", "--json"]).output().expect("perturb runs");
    let catalogue: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!(catalogue["environments"][0]["parameters"][0]["name"], "force");
    assert_eq!(catalogue["environments"][0]["parameters"][0]["E"], serde_json::json!([[1.0, 5.0], [15.0, 20.0]]));
}

#[test]
fn a_private_server_accepts_all_environments() {
    let out = tempfile::tempdir().expect("a directory");
    let path = out.path().to_str().expect("a path");
    let settings = ["--set", "num_envs=20000", "--set", "n_steps=10", "--set", "n_epochs=1"];
    let arguments = [&["train", "--env", "CartPole", "--episodes", "1", "--out", path][..], &settings].concat();
    let output = perturb(&arguments).output().expect("perturb runs");
    assert!(output.status.success(), "{}", stderr(&output));
}

#[test]
fn a_closed_pipe_ends_the_program_quietly() {
    let out = tempfile::tempdir().expect("a directory");
    let run = out.path().join("run");
    let run = run.to_str().expect("a path");
    let json = out.path().join("result.json");
    let json = json.to_str().expect("a path");
    let demo = out.path().join("demo");
    let demo = demo.to_str().expect("a path");
    let evaluate = ["evaluate", "--checkpoint", run, "--versions", "D,E", "--episodes", "5"];
    for arguments in [
        &["envs"][..],
        &["train", "--env", "CartPole", "--episodes", "5", "--out", run],
        &evaluate,
        &[&evaluate[..], &["--json", json]].concat(),
        &["demo", "--env", "CartPole", "--episodes", "5", "--test-episodes", "5", "--out", demo],
    ] {
        let mut child = perturb(arguments).spawn().expect("perturb");
        drop(child.stdout.take());
        let output = ended(child);
        assert!(output.status.success(), "{arguments:?}: {}", stderr(&output));
        assert!(!stderr(&output).contains("panicked"), "{}", stderr(&output));
    }
    assert!(Path::new(json).exists(), "the file was asked for");
}

/// The server pings its client every second, and ends the connection if no answer comes within a second.
#[test]
fn a_server_keeps_a_learner_that_computes_for_long() {
    let directory = tempfile::tempdir().expect("a directory");
    let socket = directory.path().join("server.sock");
    let address: Address = format!("unix:{}", socket.display()).parse().expect("an address");
    let program = std::env::var_os("PERTURB_SERVER").map(PathBuf::from).unwrap_or_else(|| {
        let test = std::env::current_exe().expect("this test's path");
        test.parent().and_then(Path::parent).expect("target/release").join("perturb-server")
    });
    let mut server = Command::new(program)
        .args(["--listen", &address.to_string(), "--keepalive-seconds", "1", "--exit-with-stdin", "--log", "error"])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .expect("perturb-server");
    wait_for_server(&socket);
    let servers = Servers::connect(&[address]).expect("a connection");
    let options = OpenOptions {
        environment: "CartPole".into(),
        version: Version::D,
        parameters: Default::default(),
        contexts: Vec::new(),
        num_envs: 1,
        seed: 1,
        episodes_per_trial: 1,
        observe: Default::default(),
    };
    let mut session = ClientSession::open(&servers, &options, &mut Vec::new()).expect("a session");
    let compute = || std::thread::sleep(Duration::from_secs(4));
    servers.keep_alive_during(compute);
    session.step(&[1, 0, 0, 0], &mut StepReply::default()).expect("the session lives");
    compute();
    let error = session.step(&[1, 0, 0, 0], &mut StepReply::default()).expect_err("nobody answered the server");
    assert!(error.to_string().contains("lost the server"), "{error}");
    drop(server.stdin.take());
    server.wait().expect("it ends");
}
