use super::*;

fn load(file: Option<&str>, sets: &[&str], flags: &str) -> Result<TrainConfig, ConfigError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("config.toml");
    std::fs::write(&path, file.unwrap_or_default()).unwrap();
    let sets: Vec<String> = sets.iter().map(|&set| set.to_owned()).collect();
    let flags = flags.parse().unwrap();
    TrainConfig::load(file.map(|_| path.as_path()), &sets, flags)
}

fn refusal(file: Option<&str>, sets: &[&str]) -> String {
    load(file, sets, "environment = 'CartPole'").unwrap_err().to_string()
}

fn ppo(config: &TrainConfig) -> &PpoConfig {
    match &config.settings.base {
        Base::Ppo(settings) => settings,
        Base::A2c(_) | Base::Random | Base::Heuristic => panic!("not PPO"),
    }
}

#[test]
fn the_command_line_beats_the_file_beats_the_default() {
    let file = "environment = 'CartPole'\nseed = 2\nn_steps = 256\ngamma = 0.9";
    let config = load(Some(file), &["n_steps=64"], "seed = 4").unwrap();
    assert_eq!(config.common.seed, 4);
    assert_eq!(ppo(&config).n_steps, 64);
    assert_eq!(ppo(&config).gamma, 0.9);
    assert_eq!(ppo(&config).gae_lambda, PpoConfig::default().gae_lambda);
}

#[test]
fn the_command_line_does_not_contradict_itself() {
    let refused = |sets: &[&str], flags: &str| load(None, sets, flags).unwrap_err().to_string();
    let remedy = "contradict each other: give one of them";
    let flags = "environment = 'CartPole'\nversion = 'D'";
    assert_eq!(refused(&["version=R"], flags), format!("--set version=R and --version D {remedy}"));
    assert_eq!(
        refused(&["environment=Hopper"], flags),
        format!("--set environment=Hopper and --env CartPole {remedy}")
    );
    assert_eq!(
        refused(&["n_steps=512", "n_steps=64"], flags),
        format!("--set n_steps=512 and --set n_steps=64 {remedy}")
    );
    let twice = load(None, &["version=d", "environment=cart-pole", "seed=1", "seed=1"], flags).unwrap();
    assert_eq!((twice.common.seed, twice.common.environment.as_str()), (1, "CartPole"), "the same twice is one thing");
}

#[test]
fn names_are_spelled_as_one_likes() {
    let sets = ["algorithm=EPOpt_PPO", "architecture=RC", "version=r+e", "preset=Paper", "rank_by=RAW"];
    let config = load(None, &sets, "environment = 'CartPole'").unwrap();
    assert_eq!((config.settings.name(), config.common.architecture), ("epopt-ppo", Architecture::Rc));
    assert_eq!((config.common.version, config.common.preset), (Version::RE, Preset::Paper));
    assert_eq!(config, load(Some(&config.to_toml()), &[], "").unwrap());
}

#[test]
fn keys_are_spelled_as_one_likes_and_stand_once() {
    let config =
        load(Some("Environment = 'CartPole'\nN-Steps = 64"), &["Learning-Rate=1e-3", "GAMMA=0.9"], "").unwrap();
    assert_eq!((ppo(&config).learning_rate, ppo(&config).gamma, ppo(&config).n_steps), (1e-3, 0.9, 64));
    let refused = refusal(None, &["n_steps=64", "n-steps=32"]);
    assert_eq!(refused, "--set n_steps=64 and --set n-steps=32 contradict each other: give one of them");
    let twice = refusal(Some("n_steps = 64\nn-steps = 64"), &[]);
    assert!(twice.ends_with(": n-steps and n_steps contradict each other: give one of them"), "{twice}");
    let others = refusal(None, &["Rms-Alpha=0.9"]);
    assert!(others.contains("unknown key `rms_alpha`; it is a setting of a2c"), "{others}");
}

#[test]
fn an_algorithm_brings_its_own_defaults_and_keys() {
    let config = load(None, &["algorithm=a2c", "rms_alpha=0.9"], "environment = 'Pendulum'").unwrap();
    let own = A2cConfig { learning_rate: 7e-3, n_steps: 15, ent_coef: 1e-3, ..A2cConfig::default() };
    let base = Base::A2c(A2cConfig { rms_alpha: 0.9, ..own });
    assert_eq!(config.settings, Settings { base, wrapper: Wrapper::Plain });
    let other = "unknown key `rms_alpha`; it is a setting of a2c, epopt-a2c, rl2-a2c; ppo's keys are";
    assert!(refusal(None, &["rms_alpha=0.9"]).contains(other));
}

#[test]
fn the_written_configuration_gives_the_same_again() {
    let sets = ["learning_rate=1e-3", "normalize_rewards=false", "learning_rate_schedule=linear", "ent_coef=1"];
    for (algorithm, architecture) in pairs() {
        let flags = format!(
            "environment = 'Hopper'\nversion = 'E'\nalgorithm = '{algorithm}'\narchitecture = '{architecture}'\n\
             episodes = 7"
        );
        let config = load(None, &sets, &flags).unwrap();
        assert_eq!((config.settings.name(), config.common.architecture), (algorithm, architecture));
        assert_eq!(load(Some(&config.to_toml()), &[], "").unwrap(), config);
    }
}

fn of(preset: &str, algorithm: &str, architecture: Architecture, sets: &[&str]) -> TrainConfig {
    let flags = format!(
        "environment = 'Hopper'\nalgorithm = '{algorithm}'\narchitecture = '{architecture}'\npreset = '{preset}'"
    );
    load(None, sets, &flags).unwrap()
}

/// The expected settings are those of a table in docs/algorithms.md.
#[test]
fn the_presets_differ_in_named_settings_and_in_nothing_else() {
    for (algorithm, architecture) in pairs() {
        let [ours, papers] = ["perturb", "paper"].map(|preset| of(preset, algorithm, architecture, &[]).full_table());
        assert!(ours.keys().eq(papers.keys()), "the same keys");
        let different = ours.iter().filter(|(key, value)| papers[*key] != **value);
        let different: Table = different.map(|(key, _)| (key.clone(), papers[key].clone())).collect();
        let (is_rc, is_epopt) = (architecture == Architecture::Rc, algorithm.starts_with("epopt"));
        let mut expected: Table = "preset = 'paper'\nnum_envs = 1\nreward_return_runs_on = true\nvf_coef = 0.25\n\
                                   bootstrap_truncation = false"
            .parse()
            .unwrap();
        if algorithm.ends_with("ppo") {
            expected.extend((!is_epopt).then(|| ("log_interval".into(), 10.into())));
            expected.extend(is_rc.then(|| ("n_epochs".into(), 10.into())));
        }
        if is_epopt {
            expected.insert("rank_by".into(), "normalized".into());
            expected.extend(is_rc.then(|| ("update_per_episode".into(), true.into())));
        }
        assert_eq!(different, expected, "{algorithm} {architecture}");
    }
}

/// Checks the values of both presets in the table in docs/algorithms.md. The previous test checks only the list of
/// settings that differ.
#[test]
fn each_preset_has_the_documents_values() {
    let (ff, rc) = (Architecture::Ff, Architecture::Rc);
    // Columns: `num_envs` of the preset "perturb", then `n_epochs` and `log_interval` of both presets, "perturb" first.
    for (algorithm, architecture, num_envs, n_epochs, log_interval) in [
        ("a2c", ff, 16, None, [100, 100]),
        ("a2c", rc, 16, None, [100, 100]),
        ("ppo", ff, 8, Some([10, 10]), [1, 10]),
        ("ppo", rc, 16, Some([4, 10]), [1, 10]),
        ("epopt-a2c", ff, 25, None, [1, 1]),
        ("epopt-a2c", rc, 25, None, [1, 1]),
        ("epopt-ppo", ff, 25, Some([10, 10]), [1, 1]),
        ("epopt-ppo", rc, 25, Some([4, 10]), [1, 1]),
        ("rl2-a2c", rc, 16, None, [100, 100]),
        ("rl2-ppo", rc, 16, Some([4, 10]), [1, 10]),
    ] {
        let tables = ["perturb", "paper"].map(|preset| of(preset, algorithm, architecture, &[]).full_table());
        let has = |key: &str, expected: Option<[Value; 2]>| {
            let got = tables.each_ref().map(|table| table.get(key).cloned());
            let expected = expected.map_or([None, None], |values| values.map(Some));
            assert_eq!(got, expected, "{algorithm} {architecture} {key}");
        };
        let numbers = |values: [i64; 2]| values.map(Value::from);
        has("num_envs", Some(numbers([num_envs, 1])));
        has("n_epochs", n_epochs.map(numbers));
        has("log_interval", Some(numbers(log_interval)));
        has("bootstrap_truncation", Some([true, false].map(Value::from)));
        has("vf_coef", Some([0.5, 0.25].map(Value::from)));
        has("reward_return_runs_on", Some([false, true].map(Value::from)));
        let of_epopt = |values: [Value; 2]| algorithm.starts_with("epopt").then_some(values);
        has("rank_by", of_epopt(["raw", "normalized"].map(Value::from)));
        has("update_per_episode", of_epopt([false, architecture == rc].map(Value::from)));
        // The code of Packer et al. (2018) has a setting for the KL penalty but never applies the penalty.
        let penalty = if algorithm == "rl2-ppo" { 0.2 } else { 0.0 };
        has("kl_coef", n_epochs.map(|_| [penalty, penalty].map(Value::from)));
    }
}

/// Checks the defaults that were chosen for each algorithm and architecture in trainings with seed 1. They are the same
/// in both presets.
#[test]
fn each_algorithm_has_its_recommended_rates_and_lengths() {
    let (ff, rc) = (Architecture::Ff, Architecture::Rc);
    for (algorithm, architecture, learning_rate, n_steps, ent_coef, gae_lambda) in [
        ("a2c", ff, 7e-3, Some(15), 1e-3, None),
        ("a2c", rc, 7e-3, Some(15), 1e-3, None),
        ("ppo", ff, 3e-4, Some(128), 0.0, Some(0.95)),
        ("ppo", rc, 3e-4, Some(128), 0.0, Some(0.95)),
        ("epopt-a2c", ff, 7e-2, None, 1e-4, None),
        ("epopt-a2c", rc, 7e-3, None, 1e-4, None),
        ("epopt-ppo", ff, 3e-3, None, 0.0, Some(0.95)),
        ("epopt-ppo", rc, 3e-3, None, 0.0, Some(0.95)),
        ("rl2-a2c", rc, 7e-3, Some(15), 1e-4, None),
        ("rl2-ppo", rc, 3e-4, Some(128), 0.0, Some(0.97)),
    ] {
        for preset in ["perturb", "paper"] {
            let table = of(preset, algorithm, architecture, &[]).full_table();
            let number = |key: &str| table.get(key).and_then(Value::as_float);
            let got = (number("learning_rate"), table.get("n_steps").and_then(Value::as_integer), number("ent_coef"));
            assert_eq!(got, (Some(learning_rate), n_steps, Some(ent_coef)), "{algorithm} {architecture} {preset}");
            assert_eq!(number("gae_lambda"), gae_lambda, "{algorithm} {architecture} {preset}");
            assert_eq!((table["seed"].as_integer(), table["episodes"].as_integer()), (Some(1), Some(15_000)));
        }
    }
    assert_eq!(of("perturb", "random", ff, &[]).common.num_envs, 1);
}

#[test]
fn a_preset_gives_defaults_that_every_layer_beats() {
    let config = of("paper", "epopt-ppo", Architecture::Rc, &["num_envs=7", "update_per_episode=false", "rank_by=raw"]);
    assert_eq!((config.common.num_envs, ppo(&config).n_epochs), (7, 10));
    let expected = EpoptConfig::default();
    assert_eq!(config.settings.wrapper, Wrapper::Epopt(expected), "none of the paper's is left");
    for text in [config.to_toml(), toml::to_string(&config.table()).unwrap()] {
        assert_eq!(load(Some(&text), &[], "").unwrap(), config, "and none comes back");
    }
    let file = "preset = 'paper'\nn_epochs = 3";
    let config = load(Some(file), &["architecture=rc"], "environment = 'CartPole'").unwrap();
    assert_eq!((config.common.num_envs, ppo(&config).n_epochs), (1, 3));
    assert!(refusal(None, &["preset=ours"]).contains("preset is \"ours\", but must be one of \"perturb\", \"paper\""));
}

#[test]
fn the_command_lines_preset_beats_the_files() {
    let file = "environment = 'CartPole'\nalgorithm = 'epopt-ppo'\narchitecture = 'rc'";
    let paper = format!("{file}\npreset = 'paper'");
    let loaded = |file: &str, flags: &str| load(Some(file), &[], flags).unwrap();
    assert_eq!(loaded(&paper, "preset = 'perturb'"), loaded(file, ""));
    assert_eq!(loaded(&format!("{file}\npreset = 'perturb'"), "preset = 'paper'"), loaded(&paper, ""));
}

/// Checks that the table of a configuration omits a setting that earlier versions of the program did not have, if it
/// is set to the behaviour of those versions. The names of an experiment's trainings are derived from this table, so
/// results of earlier versions are still found by name.
#[test]
fn default_preset_omits_younger_settings_with_old_values() {
    for (algorithm, architecture) in pairs() {
        let younger = ["preset", "reward_return_runs_on", "rank_by", "update_per_episode"];
        let table = of("perturb", algorithm, architecture, &[]).table();
        assert!(younger.iter().all(|key| !table.contains_key(*key)), "{table}");
        let table = of("perturb", algorithm, architecture, &["reward_return_runs_on=true"]).table();
        assert_eq!(table.get("reward_return_runs_on"), Some(&true.into()));
        let config = of("perturb", algorithm, architecture, &[]);
        assert!(config.to_toml().contains("preset = \"perturb\""), "config.toml has every setting");
    }
}

#[test]
fn a_success_rate_to_stop_at_is_written_only_where_there_is_one() {
    for preset in ["perturb", "paper"] {
        let config = |sets: &[&str]| of(preset, "ppo", Architecture::Ff, sets);
        let (plain, named, stopping) = (config(&[]), config(&["stop_at_success=0"]), config(&["stop_at_success=99.5"]));
        assert_eq!(plain, named);
        assert!(!plain.full_table().contains_key("stop_at_success"), "what cells are named by stays");
        assert_eq!(stopping.table().get("stop_at_success"), Some(&99.5.into()));
        assert_eq!(load(Some(&stopping.to_toml()), &[], "").unwrap(), stopping);
    }
    for wrong in ["-1", "100.5", "nan"] {
        let message = refusal(None, &[&format!("stop_at_success={wrong}")]);
        assert!(message.contains("stop_at_success") && message.contains("a success rate, 0 … 100 %"), "{message}");
    }
}

#[test]
fn regularisation_is_written_only_where_there_is_some() {
    for (algorithm, preset) in [("ppo", "perturb"), ("ppo", "paper"), ("epopt-a2c", "perturb"), ("rl2-ppo", "paper")] {
        let architecture = if algorithm == "rl2-ppo" { Architecture::Rc } else { Architecture::Ff };
        let config = |sets: &[&str]| of(preset, algorithm, architecture, sets);
        for (key, set) in [("observation_noise", "observation_noise=0.25"), ("weight_decay", "weight_decay=0.25")] {
            let (plain, regularised) = (config(&[]), config(&[set]));
            assert_eq!(plain, config(&[&format!("{key}=0")]));
            assert!(!plain.full_table().contains_key(key), "what cells are named by stays");
            assert_eq!(regularised.table().get(key), Some(&0.25.into()));
            assert_eq!(load(Some(&regularised.to_toml()), &[], "").unwrap(), regularised);
        }
    }
    for (wrong, expected) in [
        ("observation_noise=-1", "a standard deviation, 0 … 100"),
        ("observation_noise=nan", "a standard deviation, 0 … 100"),
        ("weight_decay=-1", "not negative, and below 1 / learning_rate"),
        ("weight_decay=1e6", "not negative, and below 1 / learning_rate"),
    ] {
        let message = refusal(None, &[wrong]);
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn what_is_observed_is_written_only_where_it_is_not_the_default() {
    for preset in ["perturb", "paper"] {
        let config = |sets: &[&str]| of(preset, "ppo", Architecture::Ff, sets);
        let (plain, named, seeing) = (config(&[]), config(&["observe=state"]), config(&["observe=parameters"]));
        assert_eq!(plain, named);
        assert!(!plain.full_table().contains_key("observe"), "what cells are named by stays, and so does config.toml");
        assert_eq!(seeing.table().get("observe"), Some(&"parameters".into()));
        assert_eq!(load(Some(&seeing.to_toml()), &[], "").unwrap(), seeing);
        assert_eq!((plain.method().observe, seeing.method().observe), (Observe::State, Observe::Parameters));
    }
    let message = refusal(None, &["observe=everything"]);
    assert!(message.contains("observe is \"everything\", but must be one of \"state\", \"parameters\""), "{message}");
}

#[test]
fn contexts_are_written_and_list_the_same_parameters() {
    let listed = "contexts=[{ length = 0.1, mass = 2 }, { length = 0.30000000000000004, mass = 1e-3 }]";
    let config = of("perturb", "ppo", Architecture::Ff, &[listed]);
    let lengths: Vec<f64> = config.common.contexts.iter().map(|context| context["length"]).collect();
    assert_eq!(lengths, [0.1, 0.1 + 0.2]);
    assert_eq!(config.common.trained_on(), "D with 2 contexts of length, mass");
    assert_eq!(load(Some(&config.to_toml()), &[], "").unwrap(), config);
    assert!(!of("perturb", "ppo", Architecture::Ff, &[]).full_table().contains_key("contexts"));
    let many = format!("contexts=[{}]", "{ length = 1 },".repeat(1025));
    for (sets, expected) in [
        (&["contexts=[{ length = 'x' }]"][..], "contexts is [{ length = \"x\" }], but must be a list of contexts"),
        (&["contexts=5"], "but must be a list of contexts"),
        (&["contexts=[{}]"], "at least one, in each context"),
        (&["contexts=[{ length = 1 }, { mass = 1 }]"], "values of the same parameters"),
        (&["contexts=[{ length = 1 }]", "parameters={ mass = 1 }"], "contexts is given in addition to parameters"),
        (&[&many], "contexts is 1025, but must be at most 1024"),
    ] {
        let message = refusal(None, sets);
        assert!(message.contains(expected), "{message}");
    }
}

/// Returns the ten pairs of algorithm and architecture of Packer et al. (2018).
fn pairs() -> impl Iterator<Item = (&'static str, Architecture)> {
    let all = Settings::names().into_iter().flat_map(|name| Architecture::ALL.map(|architecture| (name, architecture)));
    all.filter(|(name, architecture)| {
        !["random", "heuristic"].contains(name) && (!name.starts_with("rl2") || *architecture == Architecture::Rc)
    })
}

#[test]
fn ten_pairs_of_algorithm_and_architecture_are_valid() {
    assert_eq!(pairs().count(), 10);
    for algorithm in ["rl2-a2c", "rl2-ppo"] {
        let message = refusal(None, &[&format!("algorithm={algorithm}"), "architecture=ff"]);
        assert!(message.starts_with(&format!("{algorithm} cannot train the architecture ff")), "{message}");
        let config = load(None, &[&format!("algorithm={algorithm}")], "environment = 'CartPole'").unwrap();
        assert_eq!(config.common.architecture, Architecture::Rc, "the only one it has");
    }
}

#[test]
fn policies_that_do_not_learn_have_no_learner_and_no_memory() {
    for algorithm in ["random", "heuristic"] {
        for preset in Preset::ALL {
            let config = of(&preset.to_string(), algorithm, Architecture::Ff, &["episodes=7"]);
            assert!(
                !config.settings.learns() && !config.common.normalize_observations && !config.common.normalize_rewards
            );
            assert_eq!(load(Some(&config.to_toml()), &[], "").unwrap(), config);
        }
        let algorithm_key = format!("algorithm={algorithm}");
        assert!(refusal(None, &[&algorithm_key, "learning_rate=1"]).contains("unknown key `learning_rate`"));
        let message = refusal(None, &[&algorithm_key, "architecture=rc"]);
        assert!(message.contains(&format!("a {algorithm} policy has nothing to remember")), "{message}");
    }
}

#[test]
fn names_are_typed_as_they_are_written() {
    assert_eq!(
        Settings::names(),
        ["a2c", "ppo", "epopt-a2c", "epopt-ppo", "rl2-a2c", "rl2-ppo", "random", "heuristic"]
    );
    assert_eq!(serde_json::to_value(Architecture::ALL).unwrap(), serde_json::json!(Architecture::NAMES));
}

#[test]
fn wrapper_adds_its_keys_and_removes_unused_ones() {
    let config = load(None, &["algorithm=epopt-ppo", "epsilon=0.2"], "environment = 'CartPole'").unwrap();
    let expected = EpoptConfig { epsilon: 0.2, ..EpoptConfig::default() };
    assert_eq!(config.settings.wrapper, Wrapper::Epopt(expected));
    for key in ["n_steps", "n_minibatches", "episodes_per_trial"] {
        let message = refusal(None, &["algorithm=epopt-ppo", &format!("{key}=2")]);
        assert!(message.contains(&format!("unknown key `{key}`; it is a setting of ")), "{message}");
    }
    let config = load(None, &["algorithm=rl2-ppo", "episodes_per_trial=5"], "environment = 'CartPole'").unwrap();
    assert_eq!(config.settings.episodes_per_trial(), 5);
    assert!(refusal(None, &["algorithm=ppo", "episodes_per_trial=5"]).contains("unknown key"));
}

#[test]
fn an_unknown_key_is_refused_with_all_valid_ones() {
    let message = refusal(Some("learning_rat = 0.1"), &[]);
    assert!(message.contains("config.toml: unknown key `learning_rat` (did you mean `learning_rate`?); "), "{message}");
    for key in ["learning_rate,", "n_steps", "num_envs", "normalize_observations", "checkpoint_interval"] {
        assert!(message.contains(key), "{key}: {message}");
    }
    assert!(refusal(Some("[nested]\nkey = 1"), &[]).contains("unknown key `nested`"));
}

#[test]
fn a_wrong_type_is_refused_with_the_right_one() {
    for (set, part) in [
        ("learning_rate=fast", "learning_rate is \"fast\", but must be a number"),
        ("n_steps=12.5", "n_steps is 12.5, but must be a whole number"),
        ("n_steps=-1", "n_steps is -1, but must be a whole number that is not negative"),
        ("normalize_rewards=1", "normalize_rewards is 1, but must be true or false"),
        ("version=X", "version is \"X\", but must be one of \"D\", \"R\", \"E\""),
        ("algorithm=dqn", "algorithm is \"dqn\", but must be one of \"a2c\", \"ppo\", \"epopt-a2c\", "),
        ("architecture=mlp", "architecture is \"mlp\", but must be one of \"ff\", \"rc\""),
        ("learning_rate_schedule=cosine", "must be one of \"constant\", \"linear\""),
        ("num_envs=0", "num_envs is 0, but must be between 1 and 65536"),
        ("episodes=0", "episodes is 0, but must be at least 1"),
        ("gamma=2", "gamma is 2, but must be between 0 and 1"),
        ("learning_rate=nan", "learning_rate is NaN"),
        ("n_epochs=1001", "n_epochs is 1001, but must be between 1 and 1000"),
        ("n_steps", "expected key=value"),
    ] {
        let message = refusal(None, &[set]);
        assert!(message.contains(part), "{set}: {message}");
    }
    let environment = load(None, &["environment=3"], "").unwrap_err().to_string();
    assert_eq!(environment, "environment is 3, but must be a text");
    for (sets, part) in [
        (["algorithm=epopt-a2c", "epsilon=0"], "epsilon is 0, but must be above 0 and at most 1"),
        (
            ["algorithm=epopt-a2c", "episodes_per_iteration=0"],
            "episodes_per_iteration is 0, but must be between 1 and 1000000",
        ),
        (["algorithm=epopt-a2c", "num_envs=101"], "num_envs is 101, but must be at most episodes_per_iteration, 100"),
        (["algorithm=epopt-ppo", "episodes_per_iteration=10000000"], "must be between 1 and 1000000"),
        (["algorithm=rl2-a2c", "episodes_per_trial=0"], "episodes_per_trial is 0, but must be between 1 and 1000000"),
        (["algorithm=rl2-a2c", "episodes_per_trial=4000000000"], "must be between 1 and 1000000"),
        (["algorithm=ppo", "n_steps=1000000000000000000"], "but must be at most 8388608 with 8 environments"),
        (["algorithm=rl2-ppo", "kl_coef=-1"], "kl_coef is -1, but must be a number that is not negative"),
    ] {
        let message = refusal(None, &sets);
        assert!(message.contains(part), "{sets:?}: {message}");
    }
}

#[test]
fn minibatches_must_part_a_rollout_evenly() {
    assert!(load(None, &["n_steps=5", "num_envs=6", "n_minibatches=10"], "environment = 'CartPole'").is_ok());
    let message = refusal(None, &["n_steps=5", "num_envs=6", "n_minibatches=4"]);
    assert_eq!(message, "n_minibatches is 4, but must be a divisor of n_steps · num_envs, which is 30");
    let recurrent = ["architecture=rc", "n_steps=5", "num_envs=6"];
    assert!(load(None, &[&recurrent[..], &["n_minibatches=3"]].concat(), "environment = 'CartPole'").is_ok());
    let message = refusal(None, &[&recurrent[..], &["n_minibatches=10"]].concat());
    assert!(message.starts_with("n_minibatches is 10, but must be a divisor of num_envs, "), "{message}");
    assert!(message.ends_with(" which is 6"), "{message}");
}

#[test]
fn what_is_missing_or_not_toml_is_named() {
    assert!(matches!(load(None, &[], ""), Err(ConfigError::NoEnvironment)));
    assert!(refusal(Some("= 1"), &[]).contains("config.toml"));
    let missing = TrainConfig::load(Some(Path::new("/nonexistent.toml")), &[], Table::new());
    assert!(missing.unwrap_err().to_string().contains("cannot read /nonexistent.toml"));
}

#[test]
fn a_list_is_no_set_of_values() {
    let with =
        |values: &str| load(Some(&format!("environment = 'CartPole'\n[parameters]\nlength = {values}")), &[], "");
    for values in ["'0.5..1.0'", "0.5", "'0.3..0.4,0.8..0.9'"] {
        assert!(with(values).is_ok(), "{values}");
    }
    for values in ["[0.5, 1.0]", "[0.5]", "[]"] {
        let message = with(values).unwrap_err().to_string();
        assert!(message.contains("parameters.length") && message.contains("a text such as \"0.3..0.4\""), "{message}");
    }
}
