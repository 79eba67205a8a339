//! Readings, rewards and success rules agree with the simulation.

use super::{CART, TASK, folder, load};
use perturb::env::{Action, Environment, EnvironmentSpec, EpisodeSettings, Episodes, Version};

/// Loads the cart task with some lines replaced, e.g. another observation, reward or success rule.
fn with(name: &str, replaced: &[(&str, &str)]) -> &'static EnvironmentSpec {
    let mut task = TASK.replace("CartAndPole", name);
    for (key, line) in replaced {
        let old = task.lines().find(|old| old.starts_with(&format!("{key} ="))).map(str::to_owned);
        match old {
            Some(old) => task = task.replace(&old, line),
            None => task = task.replace("\n[[parameter]]", &format!("\n{line}\n\n[[parameter]]")),
        }
    }
    load(folder(&[("task.toml", &task), ("cart.xml", CART)]).path())
}

fn observed(environment: &dyn Environment) -> Vec<f32> {
    let mut out = vec![0.0; environment.spec().observation.len()];
    environment.observe(&mut out);
    out
}

fn names(spec: &EnvironmentSpec) -> Vec<&str> {
    spec.observation.iter().map(|channel| channel.name).collect()
}

#[test]
fn every_reading_of_the_cart_is_what_its_geometry_says() {
    let spec = with(
        "Reads",
        &[(
            "observation",
            r#"observation = [
  { joint = "hinge", get = "sin" }, { joint = "hinge", get = "cos" }, { joint = "rail", get = "scaled" },
  { joint = "rail", get = "velocity", scale = 0.5, clip = 0.4 }, { site = "tip", get = "position", axes = "xz" },
  { body = "pole", get = "pitch" }, { body = "pole", get = "up" }, { body = "cart", get = "velocity", axes = "x" },
  { from = { body = "cart" }, to = { site = "tip" }, get = "distance" }, { com = ["cart", "pole"], axes = "z" },
  { action = "*" }, { previous_action = "*" }, { constant = 2.5 }, { time = true }, { actuator = "push", get = "control" },
  { joint = "*", get = "position", without = ["rail"] },
]"#,
        )],
    );
    assert_eq!(
        names(spec),
        [
            "hinge_sin",
            "hinge_cos",
            "rail_scaled",
            "rail_velocity_scaled",
            "tip_x",
            "tip_z",
            "pole_pitch",
            "pole_up",
            "cart_velocity_x",
            "distance",
            "com_z",
            "action_push",
            "previous_action_push",
            "constant",
            "time",
            "push_control",
            "hinge",
        ]
    );
    let mut environment = (spec.make)().unwrap();
    let angle = 0.3f64;
    environment.reset_to(&[1.0, angle, 2.0, 0.0]);
    let expected = [
        angle.sin(),
        angle.cos(),
        0.5,
        0.4,
        1.0 + 0.8 * angle.sin(),
        0.8 * angle.cos(),
        angle,
        angle.cos(),
        2.0,
        0.8,
        0.5 * 0.4 * angle.cos() / 2.5,
        0.0,
        0.0,
        2.5,
        0.0,
        0.0,
        angle,
    ];
    for ((name, got), expected) in names(spec).iter().zip(observed(environment.as_ref())).zip(expected) {
        assert!((f64::from(got) - expected).abs() < 1e-6, "{name}: {got}, not {expected}");
    }
    environment.step(Action::Continuous(&[5.0]), &mut [0.0; 2]);
    environment.step(Action::Continuous(&[-0.5]), &mut [0.0; 2]);
    let after = observed(environment.as_ref());
    assert_eq!(after[11..16], [-0.5, 5.0, 2.5, 0.04, -0.5], "actions as received, controls as clipped");
}

#[test]
fn poses_before_are_a_timestep_older_than_poses_after() {
    let observation =
        r#"observation = [{ site = "tip", get = "position", axes = "x" }, { joint = "rail", get = "position" }]"#;
    let run = |name, poses: &str| {
        let spec = with(name, &[("observation", observation), ("poses", poses)]);
        let mut environment = (spec.make)().unwrap();
        environment.reset_to(&[0.0, 0.0, 1.0, 0.0]);
        environment.step(Action::Continuous(&[0.0]), &mut [0.0; 2]);
        observed(environment.as_ref())
    };
    let (before, after) = (run("PosesBefore", "poses = \"before\""), run("PosesAfter", "poses = \"after\""));
    assert_eq!(before[1], after[1], "positions are those after the step");
    assert!((after[0] - before[0] - 0.01).abs() < 1e-3, "1 m/s for 10 ms: {before:?} {after:?}");
}

#[test]
fn every_term_is_its_formula() {
    let spec = with(
        "Terms",
        &[(
            "reward",
            r#"reward = [
  { name = "value", value = { joint = "rail", get = "velocity" }, weight = 2.0 },
  { name = "rate", rate = { joint = "rail", get = "position" } },
  { name = "squared", squared = { joint = "*", get = "position" }, target = [0.5, 0.0], mean = true },
  { name = "norm", norm = { joint = "*", get = "velocity" }, weight = -1.0 },
  { name = "within", within = { joint = "hinge", get = "position" }, range = [0.5, 1.0], margin = 0.4 },
  { name = "tolerance", within = { joint = "hinge", get = "position" }, range = [0.5, 1.0], margin = 0.4, shape = "gaussian" },
  { name = "near", near = { joint = "rail", get = "position" }, target = 0.5, sigma = 0.3 },
  { name = "power", power = { actuator = "*" } },
  { name = "limits", limits = { joint = "*" }, weight = -0.2 },
  { name = "alive", healthy = 1.5, otherwise = -4.0 },
  { name = "time", constant = -0.1 },
  { name = "limited", squared = { action = "*" }, weight = -1.0, at_most = 0.2 },
]"#,
        )],
    );
    let mut environment = (spec.make)().unwrap();
    environment.reset_to(&[0.2, 0.3, 1.0, -0.5]);
    let mut terms = vec![0.0; spec.reward_terms.len()];
    environment.step(Action::Continuous(&[0.6]), &mut terms);
    let mut state = Vec::new();
    environment.save(&mut state);
    let [x, angle, v, w] = state[2..6] else { panic!() };
    let a = f64::from(0.6f32);
    let expected = [
        2.0 * v,
        (x - 0.2) / 0.02,
        ((x - 0.5) * (x - 0.5) + angle * angle) / 2.0,
        -(v * v + w * w).sqrt(),
        1.0 - (0.5 - angle) / 0.4,
        0.1f64.powf(((0.5 - angle) / 0.4).powi(2)),
        (-(x - 0.5) * (x - 0.5) / 0.09).exp(),
        (a * v).abs(),
        0.0,
        1.5,
        -0.1,
        -0.2,
    ];
    for ((term, got), expected) in spec.reward_terms.iter().zip(&terms).zip(expected) {
        assert!((got - expected).abs() < 1e-12, "{}: {got}, not {expected}", term.name);
    }
    environment.reset_to(&[1.995, 0.6, 0.0, 0.0]);
    let end = environment.step(Action::Continuous(&[0.0]), &mut terms);
    assert_eq!((terms[8], terms[9], end.terminated), (-0.2, -4.0, true), "at the limit, and not healthy");
    assert!(spec.reward_terms.iter().all(|term| !term.description.is_empty()));
}

#[test]
fn huge_actions_make_finite_rewards() {
    let spec = load(folder(&[("task.toml", TASK), ("cart.xml", CART)]).path());
    let mut environment = (spec.make)().unwrap();
    environment.reset_to(&[0.0; 4]);
    let mut terms = [0.0; 2];
    assert!(!environment.step(Action::Continuous(&[f32::MAX]), &mut terms).diverged);
    assert_eq!(terms, [1.0, -1e30]);
}

/// Plays an episode of 5 steps with a constant action. Returns the achieved value, and whether the episode was a
/// success.
fn achieved(name: &str, success: &str) -> (Option<f64>, bool) {
    let spec = with(name, &[("success", success), ("step_limit", "step_limit = 5")]);
    let distributions = spec.distributions(Version::D).into();
    let settings = EpisodeSettings { seed: 1, environment_index: 0, distributions, episodes_per_trial: 1 };
    let mut episodes = Episodes::new((spec.make)().unwrap(), settings);
    episodes.begin(Some(&[0.0, 0.0, 1.0, 0.0]));
    while !episodes.ended() {
        episodes.step(Action::Continuous(&[0.0]), &mut [0.0; 2]);
    }
    let end = episodes.finished(false);
    (end.achieved, end.success)
}

#[test]
fn successes_are_those_of_the_episode() {
    let rail = "{ joint = \"rail\", get = \"position\" }";
    let (greatest, success) =
        achieved("Greatest", &format!("success = {{ description = \"far\", greatest = {rail}, at_least = 0.05 }}"));
    assert!(success && greatest.unwrap() > 0.05);
    let least = format!("success = {{ description = \"far\", least = {rail}, at_most = -0.1 }}");
    assert_eq!(achieved("Least", &least), (Some(0.0), false), "the initial position counts");
    let last = format!(
        "success = {{ description = \"far\", last = {rail}, quantity = \"x\", unit = \"mm\", at_least = 0.01 }}"
    );
    assert_eq!(achieved("Last", &last), (greatest, true));
    let goal = format!("[{{ of = {rail}, above = 0.05 }}]");
    let steps = |key: &str, rest: &str| format!("success = {{ description = \"far\", {key} = {goal}, {rest} }}");
    let (first, success) = achieved("First", &steps("first", "at_most = 3"));
    assert!(success && first == Some(3.0), "{first:?}");
    assert_eq!(achieved("LastSteps", &steps("last_steps", "at_least = 4")), (Some(3.0), false));
    assert_eq!(achieved("Longest", &steps("longest", "at_least = 3")), (Some(3.0), true));
    let all = "success = { description = \"to the end\", steps = true, at_least = 5 }";
    assert_eq!(achieved("Steps", all), (Some(5.0), true));
}

#[test]
fn sensors_and_contacts_of_the_examples_are_read() {
    let spec = crate::common::catalogue().find("Quadruped").unwrap();
    let mut episodes = crate::common::episodes(spec, Version::D, 1, 0, 1);
    let at = |name: &str| spec.observation.iter().position(|channel| channel.name == name).expect(name);
    let feet: Vec<usize> = ["front_left", "back_right"].map(|leg| at(&format!("{leg}_foot_touching"))).into();
    let mut touched = 0.0;
    for _ in 0..100 {
        episodes.step(Action::Continuous(&[0.0; 8]), &mut vec![0.0; spec.reward_terms.len()]);
        let observation = crate::common::observe(&episodes);
        touched += feet.iter().map(|&foot| observation[foot]).sum::<f32>();
    }
    assert!(touched > 50.0, "it stands: {touched}");
}
