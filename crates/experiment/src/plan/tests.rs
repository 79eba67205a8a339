use perturb_settings::Preset;

use perturb_protocol::Version;

use super::*;

const SMALL: &str = "
environments = ['CartPole', 'Pendulum']
versions = ['D', 'E']
runs = 2
seed = 7
test_episodes = 30
settings = { episodes = 50 }

[[algorithm]]
name = 'a2c'
architectures = ['ff', 'rc']
settings = { num_envs = 4 }
grid = { n_steps = [5, 10], learning_rate = [7e-3, 7e-4, 7e-5] }

[[algorithm]]
name = 'ppo'
architectures = ['ff']
";

fn parse(text: &str) -> Result<Plan, PlanError> {
    Plan::parse("small.toml", text.to_owned())
}

fn refusal(from: &str, to: &str) -> String {
    assert!(SMALL.contains(from), "{from}");
    parse(&SMALL.replacen(from, to, 1)).unwrap_err().to_string()
}

#[test]
fn a_file_expands_to_the_product_of_its_lists() {
    let plan = parse(SMALL).unwrap();
    // There are (2 architectures × 6 grid points + 1) configurations × 2 environments × 2 versions.
    let expected = Counts { configurations: 13, trainings: 52, pairs: 156, all_pairs: 312, runs: 2 };
    assert_eq!(plan.counts(), expected);
    assert!(plan.cells.iter().enumerate().all(|(index, cell)| cell.index == index));
    assert_eq!(plan.environments(), ["CartPole", "Pendulum"]);
    let methods: Vec<String> = plan.methods().iter().map(ToString::to_string).collect();
    assert_eq!(methods, ["a2c ff", "a2c rc", "ppo ff"]);
}

#[test]
fn another_spelling_of_names_gives_the_same_cells() {
    let plan = parse(SMALL).unwrap();
    let ids = |plan: &Plan| plan.cells.iter().map(|cell| cell.id.clone()).collect::<Vec<_>>();
    let text = SMALL
        .replace("['CartPole', 'Pendulum']", "['perturb/cart-pole-v1', 'PENDULUM']")
        .replace("['D', 'E']", "['d', 'e']")
        .replace("'a2c'", "'A2C'")
        .replace("'rc'", "'RC'")
        .replace("{ episodes = 50 }", "{ Episodes = 50 }")
        .replace("num_envs", "num-envs")
        .replace("n_steps = [5, 10], learning_rate", "N-Steps = [5, 10], Learning-Rate");
    let spelled = parse(&text).unwrap();
    assert_eq!(ids(&spelled), ids(&plan));
    assert_eq!(spelled.environments(), ["CartPole", "Pendulum"]);
    let of = |lines: &str| parse(&SMALL.replacen("runs = 2", lines, 1)).unwrap();
    assert_eq!(ids(&of("runs = 2\npreset = 'Paper'")), ids(&of("runs = 2\npreset = 'paper'")));
    assert_eq!(of("runs = 2\nselection = 'Clean'").selection, Selection::Clean);
    let mut served = proto::Environment { name: "CartPole".into(), revision: 1, ..Default::default() };
    assert!(spelled.check(&served).is_ok());
    served.revision = 2;
    let refused = spelled.check(&served).unwrap_err().to_string();
    assert!(
        refused.contains("perturb/CartPole-v1, but must be the server's perturb/CartPole-v2, or CartPole"),
        "{refused}"
    );
    assert!(refusal("'CartPole', 'Pendulum'", "'CartPole', 'cartpole'").contains("a list without repetitions"));
    assert!(refusal("'D', 'E'", "'e', 'E'").contains("a list without repetitions"));
}

#[test]
fn a_cell_has_all_settings_and_the_seed_of_its_run() {
    let plan = parse(SMALL).unwrap();
    let expected = |run: u32, version: &str| {
        let seed = 6 + run;
        let text = format!(
            "environment = 'CartPole'\nversion = '{version}'\nalgorithm = 'a2c'\narchitecture = 'ff'\nepisodes = 50\n\
             num_envs = 4\nlearning_rate = 7e-3\nn_steps = 5\nseed = {seed}"
        );
        TrainConfig::from_table("", text.parse().unwrap()).unwrap()
    };
    for (index, run, version) in [(0, 1, "D"), (1, 2, "D"), (2, 1, "E"), (3, 2, "E")] {
        let cell = &plan.cells[index];
        assert_eq!((&cell.config, cell.run), (&expected(run, version), run));
        assert_eq!(
            cell.tests,
            Tests {
                episodes: 30,
                sets: Version::ALL.map(TestSet::from).to_vec(),
                selection: None,
                marks: Vec::new(),
                success: None
            }
        );
    }
    assert_eq!(plan.cells[0].configuration, plan.cells[3].configuration);
    assert_ne!(plan.cells[0].configuration, plan.cells[4].configuration, "the next point of the grid");
}

#[test]
fn an_id_names_a_cell_whatever_else_the_plan_has() {
    let plan = parse(SMALL).unwrap();
    let ids: BTreeSet<&str> = plan.cells.iter().map(|cell| cell.id.as_str()).collect();
    assert_eq!(ids.len(), plan.cells.len());
    let larger = SMALL.replace("runs = 2", "runs = 3").replace("['CartPole'", "['Hopper', 'CartPole'");
    let larger = parse(&larger.replace("[5, 10]", "[1, 5, 10]")).unwrap();
    for cell in &plan.cells {
        let same = larger.find(&cell.id).unwrap_or_else(|| panic!("{} is gone", cell.id));
        assert_eq!((&same.config, same.run), (&cell.config, cell.run));
    }
    for (from, to) in [("test_episodes = 30", "test_episodes = 31"), ("episodes = 50", "episodes = 51")] {
        let other = parse(&SMALL.replacen(from, to, 1)).unwrap();
        assert!(other.cells.iter().all(|cell| !ids.contains(cell.id.as_str())), "{to}");
    }
    assert_eq!(plan.find("3"), Some(&plan.cells[3]));
    assert_eq!(plan.find(&plan.cells[5].id), Some(&plan.cells[5]));
    assert_eq!(plan.find("104"), None);
}

/// The order of versions in `test_versions`, and of other lists without a meaningful order, does not affect cell ids.
#[test]
fn the_order_of_a_list_without_order_changes_no_id() {
    let with = |versions: &str| parse(&SMALL.replacen("runs = 2", &format!("runs = 2\ntest_versions = {versions}"), 1));
    let ids = |versions: &str| -> BTreeSet<String> {
        with(versions).unwrap().cells.into_iter().map(|cell| cell.id).collect()
    };
    let expected = ids("['D', 'R', 'E']");
    assert_eq!(expected, parse(SMALL).unwrap().cells.into_iter().map(|cell| cell.id).collect());
    assert_eq!(ids("['E', 'D', 'R']"), expected);
    assert!(ids("['E', 'D']").is_disjoint(&expected));
    for (from, to) in [
        ("['CartPole', 'Pendulum']", "['Pendulum', 'CartPole']"),
        ("versions = ['D', 'E']", "versions = ['E', 'D']"),
        ("['ff', 'rc']", "['rc', 'ff']"),
        ("[7e-3, 7e-4, 7e-5]", "[0.0007, 7e-5, 7e-3]"),
        (
            "n_steps = [5, 10], learning_rate = [7e-3, 7e-4, 7e-5]",
            "learning_rate = [7e-3, 7e-4, 7e-5], n_steps = [10, 5]",
        ),
    ] {
        assert!(SMALL.contains(from), "{from}");
        let other = parse(&SMALL.replacen(from, to, 1)).unwrap();
        assert_eq!(other.cells.into_iter().map(|cell| cell.id).collect::<BTreeSet<_>>(), expected, "{to}");
    }
}

#[test]
fn r_plus_e_is_a_version_and_keeps_other_ids() {
    let plan = |versions: &str| parse(&SMALL.replacen("versions = ['D', 'E']", versions, 1)).unwrap();
    let tests = "test_versions = ['D', 'R', 'E']";
    let with = plan(&format!("versions = ['D', 'E', 'R+E']\n{tests}"));
    let without: BTreeSet<String> =
        plan(&format!("versions = ['D', 'E']\n{tests}")).cells.into_iter().map(|it| it.id).collect();
    let (both, others): (Vec<_>, Vec<_>) =
        with.cells.into_iter().partition(|cell| cell.trained_on() == TrainedOn::Version(Version::RE));
    assert_eq!(others.into_iter().map(|cell| cell.id).collect::<BTreeSet<_>>(), without);
    assert!(!both.is_empty());
    for cell in both {
        assert!(cell.id.contains("-R-or-E-") && cell.set.is_none(), "{}", cell.id);
        assert!(cell.id.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c)), "{}", cell.id);
        assert_eq!(cell.config.common.trained_on(), "R+E");
    }
    let tested = plan("versions = ['D']\ntest_versions = ['R+E', 'E', 'D']").cells.remove(0).tests.sets;
    assert_eq!(tested.iter().map(|set| set.name.as_str()).collect::<Vec<_>>(), ["D", "E", "R+E"]);
}

#[test]
fn selection_needs_several_configurations_of_one_method() {
    let each = "environments = ['CartPole', 'Pendulum']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']";
    let two = format!(
        "{each}\nenvironments = ['CartPole']\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']\n\
                       environments = ['Pendulum']\nsettings = {{ n_steps = 9 }}"
    );
    let with_set = format!("versions = ['D', 'mine']\n{each}\n[sets.mine]\nlength = '0.4..0.6'");
    let with_sets_of_two =
        with_set.replace("architectures = ['ff']", "architectures = ['ff']\ngrid = { n_steps = [5, 9] }");
    for (text, selects) in [(SMALL, true), (each, false), (&two, false), (&with_set, false), (&with_sets_of_two, true)]
    {
        assert_eq!(parse(text).unwrap().selects(), selects, "{text}");
    }
}

#[test]
fn an_invalid_cell_is_refused_with_its_table_and_key() {
    for (from, to, parts) in [
        ("7e-3,", "-1,", &["small.toml: [[algorithm]] 1 (a2c): [algorithm.grid]: learning_rate is -1"][..]),
        ("num_envs = 4", "num_envs = 0", &["[[algorithm]] 1 (a2c): [algorithm.settings]: num_envs is 0"]),
        ("episodes = 50 }", "gama = 0.9 }", &["(a2c): [settings]:", "unknown key `gama`"]),
        (
            "n_steps = [5, 10]",
            "n_epochs = [1]",
            &[
                "[algorithm.grid]:",
                "unknown key `n_epochs`; it is a setting of ppo, epopt-ppo, rl2-ppo; a2c's keys are",
            ],
        ),
        ("'a2c'", "'a3c'", &["[[algorithm]] 1 (a3c): algorithm is \"a3c\""]),
        ("'ff', 'rc'", "'ff', 'cnn'", &["(a2c): architecture is \"cnn\""]),
    ] {
        let message = refusal(from, to);
        for part in parts {
            assert!(message.contains(part), "{to}: {message}");
        }
    }
}

#[test]
fn an_invalid_plan_is_refused_with_its_key() {
    for (from, to, part) in [
        ("runs = 2", "runs = 0", "runs is 0, but must be at least 1"),
        ("runs = 2", "run = 2", "unknown field `run` (did you mean `runs`?), expected one of `title`, "),
        ("test_episodes = 30", "test_episode = 30", "unknown field `test_episode` (did you mean `test_episodes`?)"),
        ("seed = 7", "colour = 7", "unknown field `colour`, expected one of `title`, "),
        (
            "{ episodes = 50 }",
            "{ episodes = 50, Episodes = 50 }",
            "[settings]: Episodes and episodes contradict each other",
        ),
        ("seed = 7", "seed = -7", "seed"),
        ("seed = 7", "seed = 9223372036854775807", "seed is 9223372036854775807, but must be at most"),
        ("test_episodes = 30", "test_episodes = 0", "test_episodes is 0"),
        ("runs = 2", "runs = 2\nevaluate_at = [9, 5]", "evaluate_at is [9, 5], but must be numbers of episodes"),
        ("runs = 2", "runs = 2\nevaluate_at = [0]", "evaluate_at is [0], but must be"),
        (
            "runs = 2",
            "runs = 2\nevaluate_at = [9, 51]",
            "(a2c): evaluate_at is 51, but must be at most the 50 episodes",
        ),
        ("['CartPole', 'Pendulum']", "[]", "environments is empty"),
        ("['CartPole', 'Pendulum']", "['CartPole', 'CartPole']", "a list without repetitions"),
        ("['CartPole', 'Pendulum']", "['../CartPole']", "environments is `../CartPole`, but must be names of letters"),
        (
            "versions = ['D', 'E']",
            "versions = ['X']",
            "a version is `X`, but must be one of D, E, R, R+E, or a set [sets.X]",
        ),
        ("n_steps = [5, 10]", "n_steps = 5", "[algorithm.grid] n_steps is 5, but must be a list"),
        ("n_steps = [5, 10]", "n_steps = []", "[algorithm.grid] n_steps is empty"),
        ("n_steps = [5, 10]", "num_envs = [5, 10]", "num_envs is in both"),
        ("num_envs = 4", "seed = 4", "[algorithm.settings] seed is 4, but must be left out"),
        ("name = 'ppo'\narchitectures = ['ff']", "name = 'ppo'\narchitectures = []", "(ppo): architectures is empty"),
        (
            "[[algorithm]]",
            "[sets.short]\nlength = [0.3, 0.4]\n[[algorithm]]",
            "[sets.short]: length is [0.3, 0.4], but must be a value, or a text such as",
        ),
    ] {
        let message = refusal(from, to);
        assert!(message.contains("small.toml") && message.contains(part), "{to}: {message}");
    }
}

#[test]
fn marks_are_below_the_budget_and_change_cell_ids() {
    let with =
        |marks: &str| parse(&SMALL.replacen("runs = 2", &format!("runs = 2\nevaluate_at = {marks}"), 1)).unwrap();
    let plan = with("[5, 20, 50]");
    assert!(plan.cells.iter().all(|cell| cell.tests.marks == [5, 20]), "the last is the test at the end");
    assert_eq!(with("[50]").cells, parse(SMALL).unwrap().cells);
    assert!(
        plan.cells.iter().all(|cell| with("[5]").find(&cell.id).is_none() && with("[50]").find(&cell.id).is_none())
    );
    let clean = SMALL.replacen("runs = 2", "runs = 2\nselection = 'clean'\nevaluate_at = [5]", 1);
    let clean = parse(&clean).unwrap();
    assert!(clean.cells.iter().all(|cell| cell.tests.marks.is_empty()));
    assert!(clean.candidates.iter().all(|cell| cell.tests.marks == [5]));
}

#[test]
fn trainings_on_a_list_have_its_first_rows() {
    let text = "environments = ['CartPole', 'Pendulum']\nversions = ['few', 'all']\ntest_versions = ['R', 'few']
        [sets]\nfew = { file = 'own-{environment}.csv', rows = 2 }\nall = { file = 'own-{environment}.csv', version = 'R' }
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    let csv_file = |name: &str| match name {
        "own-CartPole.csv" => Ok(b"force\n5\n6\n7\n".to_vec()),
        "own-Pendulum.csv" => Ok(b"length,mass\n1,2\n3,4\n5,6\n".to_vec()),
        other => Err(format!("`{other}`")),
    };
    let parse = |text: &str| Plan::parse_with("plan.toml", text.into(), Path::new(""), &csv_file);
    let plan = parse(text).unwrap();
    let trained = |cell: &Cell| {
        let common = &cell.config.common;
        let values = common.contexts.iter().flat_map(|context| context.values().copied());
        (common.environment.clone(), cell.trained_on().to_string(), common.version, values.collect::<Vec<_>>())
    };
    let expected = |environment: &str, set: &str, version, values: &[f64]| {
        (environment.to_owned(), set.to_owned(), version, values.to_vec())
    };
    assert_eq!(
        plan.cells.iter().map(trained).collect::<Vec<_>>(),
        [
            expected("CartPole", "few", Version::D, &[5.0, 6.0]),
            expected("CartPole", "all", Version::R, &[5.0, 6.0, 7.0]),
            expected("Pendulum", "few", Version::D, &[1.0, 2.0, 3.0, 4.0]),
            expected("Pendulum", "all", Version::R, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]),
        ]
    );
    for cell in &plan.cells {
        let tested = cell.tests.sets.iter().find(|set| set.name == "few").unwrap();
        assert!(cell.set.as_deref() != Some("few") || tested.listed() == cell.config.common.contexts);
    }
    assert!(plan.files().map(|(name, _)| name).eq(["own-CartPole.csv", "own-Pendulum.csv", "plan.toml"]));
    let other = parse(&text.replace("rows = 2", "rows = 1")).unwrap();
    assert!(plan.cells.iter().all(|cell| other.find(&cell.id).is_none()), "the tests differ, too");
    for (from, to, part) in [
        ("rows = 2", "rows = 4", "rows is 4, but must be at most 3, the number of rows in own-CartPole.csv"),
        ("rows = 2", "rows = 0", "rows is 0, but must be a number of rows"),
        ("file = 'own-{environment}.csv', rows", "force = 5, rows", "rows is given without file"),
        ("own-{environment}", "their-{environment}", "file is `their-CartPole.csv`"),
    ] {
        let message = parse(&text.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(message.contains(part), "{to}: {message}");
    }
}

#[test]
fn a_cell_asked_for_twice_is_refused() {
    let message = parse(&format!("{SMALL}\n[[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\nversions = ['E']"))
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("[[algorithm]] 2 (ppo) and [[algorithm]] 3 (ppo) both contain the cell CartPole-ppo-ff-E-"),
        "{message}"
    );
}

#[test]
fn a_table_may_choose_its_environments_and_versions() {
    let text = format!("{SMALL}environments = ['Acrobot']\nversions = ['R']");
    let plan = parse(&text).unwrap();
    let last = &plan.cells[plan.cells.len() - 1].config.common;
    assert_eq!((last.environment.as_str(), last.version), ("Acrobot", Version::R));
    assert_eq!(plan.counts().trainings, 49);
}

#[test]
fn trials_of_different_lengths_are_different_methods() {
    let text = "environments = ['CartPole']
        [[algorithm]]\nname = 'rl2-a2c'\narchitectures = ['rc']\nsettings = { episodes_per_trial = 1 }
        [[algorithm]]\nname = 'rl2-a2c'\narchitectures = ['rc']
        [[algorithm]]\nname = 'epopt-a2c'\narchitectures = ['rc']";
    let methods: Vec<String> = parse(text).unwrap().methods().iter().map(ToString::to_string).collect();
    assert_eq!(methods, ["rl2-a2c rc N=1", "rl2-a2c rc N=2", "epopt-a2c rc"]);
}

#[test]
fn preset_of_plan_or_table_decides_success_rule() {
    let text = "environments = ['Pendulum', 'Acrobot']\npreset = 'paper'
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']\npreset = 'perturb'";
    let plan = parse(text).unwrap();
    let methods: Vec<String> = plan.methods().iter().map(ToString::to_string).collect();
    assert_eq!(methods, ["ppo ff (paper)", "ppo ff"]);
    let rule = |plan: &Plan, environment: &str, preset| {
        let has = |cell: &&Cell| cell.config.common.environment == environment && cell.config.common.preset == preset;
        plan.cells.iter().find(has).unwrap().tests.success.clone().map(|rule| rule.to_string())
    };
    let code = Some("code".to_owned());
    assert_eq!([Preset::Paper, Preset::Perturb].map(|preset| rule(&plan, "Acrobot", preset)), [code.clone(), None]);
    let plan = parse(&format!("success = 'text'\n{text}")).unwrap();
    assert_eq!(rule(&plan, "Acrobot", Preset::Paper), None);
    let plan = parse(&format!("{text}\n[success]\nAcrobot = 'steps=85'\nPendulum = 'text'")).unwrap();
    let rules = ["Acrobot", "Pendulum"].map(|environment| rule(&plan, environment, Preset::Paper));
    assert_eq!(rules, [Some("steps=85".into()), None]);
    for (from, to, part) in [
        ("preset = 'paper'", "success = 'steps=85'", "success is steps=85, but must be \"text\" or \"code\""),
        ("preset = 'paper'", "success = 'mine'", "\"text\", \"code\", or a table of environments"),
        (
            "preset = 'paper'",
            "success = { Acrobot = 'text', acrobot = 'code' }",
            "[success] is `acrobot`, but must be an environment that has no rule yet: Acrobot has one",
        ),
        ("preset = 'paper'", "preset = 'mine'", "unknown variant `mine`"),
        ("preset = 'paper'", "settings = { preset = 'paper' }", "[settings] preset is \"paper\", but must be left out"),
    ] {
        let message = parse(&text.replacen(from, to, 1)).unwrap_err().to_string();
        assert!(message.contains(part), "{to}: {message}");
    }
}

/// Cells of the preset "perturb" keep their ids from before presets existed.
#[test]
fn cells_of_the_usual_preset_keep_their_names() {
    let names = |text: &str| -> Vec<String> { parse(text).unwrap().cells.into_iter().map(|cell| cell.id).collect() };
    let text = "environments = ['Acrobot']\nversions = ['R']
        [success]\nAcrobot = 'steps=90'
        [[algorithm]]\nname = 'epopt-a2c'\narchitectures = ['rc']
        [[algorithm]]\nname = 'ppo'\narchitectures = ['ff']";
    let expected = ["Acrobot-epopt-a2c-rc-R-3b03e8da-s1", "Acrobot-ppo-ff-R-88e4a644-s1"];
    assert_eq!(names(text), expected);
    assert_eq!(names(&format!("preset = 'perturb'\n{text}")), expected);
}

#[test]
fn a_plan_with_too_many_cells_is_refused_before_it_is_expanded() {
    let values: Vec<String> = (1..=100).map(|number| format!("{number}e-6")).collect();
    let values = values.join(", ");
    let text = format!(
        "environments = ['CartPole']\nruns = 4294967295\n[[algorithm]]\nname = 'a2c'\narchitectures = ['ff']
        [algorithm.grid]\nlearning_rate = [{values}]\nent_coef = [{values}]\nvf_coef = [{values}]\ngamma = [{values}]"
    );
    let message = Plan::parse("test", text).unwrap_err().to_string();
    assert!(message.contains("[[algorithm]] 1 (a2c)") && message.contains("at most 1000000"), "{message}");
}
