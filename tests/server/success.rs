//! Ends of episodes and success, at the boundaries of their rules.

use crate::common::{episodes, observe, settings, step};
use perturb::{
    env::{
        Achievement, Action, ActionSpec, ChannelSpec, DrawPurpose, Environment, EnvironmentSpec, Episodes, Error,
        FinishedEpisode, Outcome, PhiloxStream, RewardTermSpec, SuccessComparison, SuccessRuleSpec, Transition,
        Version,
    },
    scene::Scene,
    tasks,
};
use rstest::rstest;

const LIMIT: u32 = 8;
const TIME: &[ChannelSpec] = &[ChannelSpec::unbounded("time", "1")];

const fn scripted_spec(achievement: Achievement, comparison: SuccessComparison, threshold: f64) -> EnvironmentSpec {
    EnvironmentSpec {
        name: "Scripted",
        revision: 0,
        description: "Plays a script of transitions.",
        make: &|| unreachable!("it is given its script"),
        parameters: &[],
        observation: TIME,
        action: ActionSpec::Discrete(&["nothing", "something"]),
        state: TIME,
        reward_terms: &[RewardTermSpec { name: "none", description: "0" }],
        applied: &[],
        step_limit: LIMIT,
        control_timestep: 1.0,
        step_cost: 0.1,
        success: SuccessRuleSpec { description: "", achievement, comparison, threshold },
        push: None,
        code_success: None,
        heatmap_axes: None,
    }
}

static LASTED_5: EnvironmentSpec = scripted_spec(Achievement::Length, SuccessComparison::AtLeast, 5.0);
static REACHED_WITHIN_5: EnvironmentSpec = scripted_spec(Achievement::FirstGoal, SuccessComparison::AtMost, 5.0);
static HELD_FOR_LAST_3: EnvironmentSpec = scripted_spec(Achievement::LastGoals, SuccessComparison::AtLeast, 3.0);
static HELD_FOR_ANY_3: EnvironmentSpec = scripted_spec(Achievement::LongestGoals, SuccessComparison::AtLeast, 3.0);

/// An environment that follows a script of one character a step: `.` nothing, `g` the goal holds, `T` terminated, `G`
/// both, `D` diverged.
struct Scripted {
    spec: &'static EnvironmentSpec,
    script: &'static [u8],
    time: usize,
}

impl Environment for Scripted {
    fn spec(&self) -> &'static EnvironmentSpec {
        self.spec
    }

    fn set_parameters(&mut self, _: &[f64]) {}

    fn applied(&self, _: &mut [f64]) {}

    fn reset(&mut self, _: &mut PhiloxStream) {
        self.time = 0;
    }

    fn reset_to(&mut self, _: &[f64]) {
        self.time = 0;
    }

    fn observe(&self, out: &mut [f32]) {
        out[0] = self.time as f32;
    }

    fn scene(&self) -> Option<Scene> {
        None
    }

    fn step(&mut self, _: Action<'_>, reward_terms: &mut [f64]) -> Transition {
        reward_terms[0] = 0.0;
        let mark = self.script[self.time];
        self.time += 1;
        Transition { terminated: b"TGD".contains(&mark), goal: b"gG".contains(&mark), diverged: mark == b'D' }
    }

    fn save(&self, _: &mut Vec<f64>) {}

    fn load(&mut self, _: &[f64]) -> Result<(), Error> {
        Ok(())
    }
}

/// Plays a script, whose last character must end the episode. Returns the last outcome, and the ended episode.
fn run(spec: &'static EnvironmentSpec, script: &'static str) -> (Outcome, FinishedEpisode) {
    let scripted = Scripted { spec, script: script.as_bytes(), time: 0 };
    let mut e = Episodes::new(Box::new(scripted), settings(spec, Version::D, 0, 0, 1));
    for t in 1..=script.len() {
        let (outcome, _) = step(&mut e, &[0; 4]);
        assert_eq!(e.ended(), t == script.len(), "{script} at step {t}");
        if e.ended() {
            return (outcome, e.finished(false));
        }
    }
    panic!("{script} does not end")
}

#[rstest]
#[case::a_step_too_few("...T", false)]
#[case::the_last_step_counts("....T", true)]
#[case::to_the_limit("........", true)]
#[case::the_goal_does_not_matter("gggG", false)]
fn lasting_counts_every_step_the_last_included(#[case] script: &'static str, #[case] success: bool) {
    assert_eq!(run(&LASTED_5, script).1.success, success);
}

#[rstest]
#[case::in_the_last_step("....G", true)]
#[case::a_step_too_late(".....G", false)]
#[case::in_the_first_step("G", true)]
#[case::never("........", false)]
#[case::it_need_not_hold_on_nor_end_the_episode("....g...", true)]
#[case::holding_does_not_help(".....ggg", false)]
#[case::the_first_time_counts("..g...gg", true)]
fn reaching_counts_the_first_step_after_which_the_goal_held(#[case] script: &'static str, #[case] success: bool) {
    assert_eq!(run(&REACHED_WITHIN_5, script).1.success, success);
}

#[rstest]
#[case::the_last_three(".....ggg", true)]
#[case::a_step_too_few("......gg", false)]
#[case::a_gap_before_the_last("gggggg.g", false)]
#[case::a_gap_before_the_last_two("ggggg.gg", false)]
#[case::not_in_the_last("ggggggg.", false)]
#[case::always("gggggggg", true)]
fn holding_counts_the_last_steps_without_a_gap(#[case] script: &'static str, #[case] success: bool) {
    assert_eq!(run(&HELD_FOR_LAST_3, script).1.success, success);
}

#[rstest]
#[case::the_last_three(".....ggg", 3.0)]
#[case::the_first_three("ggg.....", 3.0)]
#[case::the_longest_counts("gggg.ggg", 4.0)]
#[case::a_step_too_few("gg.gg.gg", 2.0)]
#[case::never("........", 0.0)]
fn holding_anywhere_counts_the_longest_time_without_a_gap(#[case] script: &'static str, #[case] achieved: f64) {
    let (_, end) = run(&HELD_FOR_ANY_3, script);
    assert_eq!((end.achieved, end.success), (Some(achieved), achieved >= 3.0));
}

#[test]
fn a_snapshot_keeps_the_longest_time() {
    let scripted = || Scripted { spec: &HELD_FOR_ANY_3, script: b"ggg.g...", time: 0 };
    let settings = settings(&HELD_FOR_ANY_3, Version::D, 0, 0, 1);
    let mut e = Episodes::new(Box::new(scripted()), settings.clone());
    (0..5).for_each(|_| drop(step(&mut e, &[0; 4])));
    let mut restored = Episodes::new(Box::new(Scripted { script: b"...", ..scripted() }), settings);
    restored.restore(&e.snapshot()).unwrap();
    assert_eq!(restored.snapshot(), e.snapshot());
    (0..3).for_each(|_| drop(step(&mut restored, &[0; 4])));
    assert_eq!(restored.finished(false).achieved, Some(3.0));
}

#[rstest]
#[case::terminated("......T", (true, false, LIMIT - 1))]
#[case::truncated("........", (false, true, LIMIT))]
#[case::both(".......T", (true, true, LIMIT))]
fn terminated_and_truncated_are_independent(#[case] script: &'static str, #[case] flags: (bool, bool, u32)) {
    let (outcome, end) = run(&LASTED_5, script);
    assert_eq!((outcome.terminated, outcome.truncated, end.length), flags);
}

#[test]
fn divergence_is_reported_with_the_episode() {
    assert!(run(&LASTED_5, "..D").1.diverged);
    assert!(!run(&LASTED_5, "..T").1.diverged);
}

#[rstest]
#[case("CartPole", [0.0, 0.0, 0.1, 1e30])]
#[case("Acrobot", [0.1, 0.1, 1e300, 1e300])]
fn state_beyond_f32_ends_the_episode(#[case] name: &str, #[case] state: [f64; 4]) {
    let mut environment = tasks::catalogue().find(name).and_then(|spec| (spec.make)()).unwrap();
    environment.reset_to(&state);
    let mut terms = [f64::NAN];
    let transition = environment.step(Action::Discrete(1), &mut terms);
    assert!(transition.diverged && transition.terminated);
    assert!(terms[0].is_finite());
    let mut kept = Vec::new();
    environment.save(&mut kept);
    assert_eq!(kept, state);

    let (_, end) = drive(name, &state, |_, _| 1);
    assert!(end.diverged && !end.success && end.length == 1);
}

#[test]
fn counts_start_anew_with_every_episode() {
    let scripted = Scripted { spec: &HELD_FOR_LAST_3, script: b"gg......", time: 0 };
    let mut e = Episodes::new(Box::new(scripted), settings(&HELD_FOR_LAST_3, Version::D, 0, 0, 1));
    for _ in 0..3 {
        step(&mut e, &[0; 4]);
        step(&mut e, &[0; 4]);
        let end = e.finished(false);
        assert_eq!((end.length, end.success), (2, false));
        e.begin(None);
    }
}

// The real environments, with episodes on both sides of their success rules.

/// Plays an environment with discrete actions from this state to the end of the episode. `policy` chooses actions from
/// time and observation.
fn drive(name: &str, state: &[f64], policy: impl Fn(u32, &[f32]) -> i32) -> (Outcome, FinishedEpisode) {
    let mut e = episodes(tasks::catalogue().find(name).unwrap(), Version::D, 0, 0, 1);
    e.begin(Some(state));
    for t in 0.. {
        let action = policy(t, &observe(&e)).to_le_bytes();
        let (outcome, _) = step(&mut e, &action);
        if e.ended() {
            return (outcome, e.finished(false));
        }
    }
    unreachable!("every episode has a step limit")
}

#[rstest]
#[case("CartPole", "the episode lasted at least 196 steps", 196.0)]
#[case("MountainCar", "the goal was reached within 110 steps", 110.0)]
#[case("Acrobot", "the height was reached within 90 steps", 90.0)]
fn the_papers_code_has_thresholds_of_its_own(#[case] name: &str, #[case] description: &str, #[case] threshold: f64) {
    let spec = tasks::catalogue().find(name).unwrap();
    let code = spec.code_success.unwrap_or(spec.success);
    assert_eq!((code.description, code.threshold), (description, threshold));
    assert_eq!((code.achievement, code.comparison), (spec.success.achievement, spec.success.comparison));
}

/// Returns whether an episode is a success by the rule of the paper's code.
fn by_code(name: &str, end: &FinishedEpisode) -> bool {
    let code = tasks::catalogue().find(name).unwrap().code_success.expect("a rule of its own");
    end.code_achieved.is_some_and(|achieved| match code.comparison {
        SuccessComparison::AtLeast => achieved >= code.threshold,
        SuccessComparison::AtMost => achieved <= code.threshold,
    })
}

#[test]
fn cart_pole_succeeds_from_195_steps() {
    let mut lengths = Vec::new();
    for fall_from in 150..=200 {
        for angle in [-0.03, -0.01, 0.01, 0.02, 0.03] {
            let balance = |t, o: &[f32]| {
                if t >= fall_from { 1 } else { i32::from(o[0] + 2.0 * o[1] + 20.0 * o[2] + 4.0 * o[3] > 0.0) }
            };
            let (outcome, end) = drive("CartPole", &[0.0, 0.0, angle, 0.0], balance);
            assert_eq!(end.success, end.length >= 195, "{} steps", end.length);
            assert_eq!(by_code("CartPole", &end), end.length >= 196, "{} steps", end.length);
            assert_eq!((outcome.truncated, end.total_reward), (end.length == 200, f64::from(end.length)));
            lengths.push(end.length);
        }
    }
    assert!([194, 195, 200].iter().all(|length| lengths.contains(length)), "both sides were seen: {lengths:?}");
}

/// Plays MountainCar: waits at the bottom of the valley, then builds up energy by pushing in the direction of motion.
fn mountain_car(wait: u32, position: f64) -> (Outcome, FinishedEpisode) {
    drive("MountainCar", &[position, 0.0], |t, o| if t < wait { 1 } else { if o[1] < 0.0 { 0 } else { 2 } })
}

#[test]
fn mountain_car_succeeds_up_to_110_steps() {
    let mut lengths = Vec::new();
    for wait in 0..60 {
        for position in [-0.6, -0.55, -0.52, -0.5, -0.45, -0.4] {
            let (outcome, end) = mountain_car(wait, position);
            assert_eq!(end.success, outcome.terminated && end.length <= 110, "{} steps", end.length);
            assert_eq!(end.total_reward, -f64::from(end.length), "-1 for every step, the last included");
            lengths.push(end.length);
        }
    }
    assert!(lengths.contains(&110) && lengths.contains(&111), "both sides were seen: {lengths:?}");
}

#[test]
fn mountain_car_may_reach_the_goal_at_the_limit() {
    let mut both = 0;
    for wait in 60..130 {
        for position in [-0.6, -0.55, -0.5, -0.45, -0.4] {
            let (outcome, end) = mountain_car(wait, position);
            assert_eq!(outcome.truncated, end.length == 200);
            both += u32::from(outcome.terminated && outcome.truncated);
        }
    }
    assert!(both > 0);
}

#[test]
fn acrobot_succeeds_up_to_80_steps() {
    let mut lengths = Vec::new();
    for wait in 0..60 {
        for angle in [-0.1, -0.05, -0.01, 0.005, 0.02, 0.03, 0.07, 0.1] {
            // A torque in the direction of the first link's velocity adds energy.
            let pump = |t, o: &[f32]| if t < wait { 1 } else { if o[4] > 0.0 { 0 } else { 2 } };
            let (outcome, end) = drive("Acrobot", &[angle, 0.0, 0.0, 0.0], pump);
            assert_eq!(end.success, outcome.terminated && end.length <= 80, "{} steps", end.length);
            assert_eq!(by_code("Acrobot", &end), outcome.terminated && end.length <= 90, "{} steps", end.length);
            if outcome.terminated {
                assert_eq!(end.total_reward, 1.0 - f64::from(end.length), "0 for the step that ends it");
                lengths.push(end.length);
            }
        }
    }
    let seen = [80, 81, 90, 91].iter().all(|length| lengths.contains(length));
    assert!(seen, "both sides were seen: {lengths:?}");
}

/// Plays an episode of a pendulum that is held at an angle in each step. Returns whether the pendulum was near upright
/// after each step, and the ended episode.
fn pendulum(angle: impl Fn(u32) -> f32) -> (Vec<bool>, FinishedEpisode) {
    let spec = tasks::catalogue().find("Pendulum").unwrap();
    // The rod is light enough for the torque to hold it at any angle.
    let light = [("length", 1.0), ("mass", 0.1)].map(|(name, value)| (name, perturb::env::Distribution::fixed(value)));
    let mut settings = settings(spec, Version::D, 0, 0, 1);
    perturb::env::resolve(spec, std::sync::Arc::make_mut(&mut settings.distributions), light).unwrap();
    let mut e = Episodes::new((spec.make)().unwrap(), settings);
    e.begin(Some(&[f64::from(angle(0)), 0.0]));
    let mut near = Vec::new();
    for t in 0..spec.step_limit {
        let [cos, sin, velocity] = observe(&e)[..] else { panic!("three numbers") };
        // The acceleration is 15 sin θ by gravity and 30 u by the torque.
        let torque = -0.5 * sin + 2.0 * (angle(t) - sin.atan2(cos)) - 0.4 * velocity;
        step(&mut e, &torque.to_le_bytes());
        near.push(observe(&e)[0] > 0.5); // within π/3
    }
    assert!(e.ended());
    (near, e.finished(false))
}

#[test]
fn pendulum_succeeds_if_the_last_100_steps_were_near_upright() {
    let mut entries = Vec::new();
    for release in 80..110 {
        let (near, end) = pendulum(|t| if t < release { 1.3 } else { 0.0 });
        let held = near.iter().rev().take_while(|near| **near).count();
        assert_eq!(end.success, held >= 100, "held for {held} steps");
        entries.push(held);
    }
    assert!(entries.contains(&99) && entries.contains(&100), "both sides were seen: {entries:?}");
}

#[test]
fn pendulum_succeeds_after_100_steps_near_upright() {
    let code = tasks::catalogue().find("Pendulum").unwrap().code_success.unwrap();
    let mut entries = Vec::new();
    for left in 80..110 {
        let (near, end) = pendulum(|t| if (20..20 + left).contains(&t) { 0.0 } else { 1.3 });
        let held = near.iter().filter(|near| **near).count(); // they are consecutive steps
        assert_eq!((end.achieved, end.code_achieved), (Some(0.0), Some(held as f64)));
        assert_eq!((end.success, code.holds(end.code_achieved)), (false, held >= 100), "held for {held} steps");
        entries.push(held);
    }
    assert!(entries.contains(&99) && entries.contains(&100), "both sides were seen: {entries:?}");
}

// The conditions of goals and ends of episodes, on both sides of their thresholds.

/// Takes a step from random states between `low` and `high`, and compares the new state's (terminated, goal) with
/// `expected`. Some new states lie within 1e-3 of the threshold on either side. `margin` is positive where the goal
/// holds.
fn check_goal(
    name: &str,
    low: &[f64],
    high: &[f64],
    expected: impl Fn(&[f64]) -> (bool, bool),
    margin: impl Fn(&[f64]) -> f64,
) {
    let mut environment = tasks::catalogue().find(name).and_then(|spec| (spec.make)()).unwrap();
    let mut stream = PhiloxStream::new(1, 0, DrawPurpose::InitialState, 0);
    let mut terms = vec![0.0; environment.spec().reward_terms.len()];
    let mut near = [0, 0];
    for _ in 0..100_000 {
        let state: Vec<f64> = low.iter().zip(high).map(|(low, high)| stream.uniform(*low, *high)).collect();
        environment.reset_to(&state);
        let action = match environment.spec().action {
            ActionSpec::Discrete(_) => Action::Discrete(1),
            ActionSpec::Continuous(_) => Action::Continuous(&[0.0]),
        };
        let transition = environment.step(action, &mut terms);
        let mut state = Vec::new();
        environment.save(&mut state);
        assert_eq!((transition.terminated, transition.goal), expected(&state), "{name} at {state:?}");
        if margin(&state).abs() < 1e-3 {
            near[usize::from(margin(&state) > 0.0)] += 1;
        }
    }
    assert!(near[0] > 10 && near[1] > 10, "{name}: {near:?} states close to the threshold");
}

fn angle_left(s: &[f64]) -> f64 {
    12.0_f64.to_radians() - s[2].abs()
}

fn track_left(s: &[f64]) -> f64 {
    2.4 - s[0].abs()
}

#[rstest]
#[case::either_angle([-0.1, -1.0, -0.25, -1.0], [0.1, 1.0, 0.25, 1.0], angle_left)]
#[case::right([2.3, -1.0, -0.1, -1.0], [2.5, 1.0, 0.1, 1.0], track_left)]
#[case::left([-2.5, -1.0, -0.1, -1.0], [-2.3, 1.0, 0.1, 1.0], track_left)]
fn cart_pole_ends_beyond_2_4_m_or_12_degrees(
    #[case] low: [f64; 4],
    #[case] high: [f64; 4],
    #[case] margin: fn(&[f64]) -> f64,
) {
    let inside = |s: &[f64]| angle_left(s) >= 0.0 && track_left(s) >= 0.0;
    check_goal("CartPole", &low, &high, |s| (!inside(s), inside(s)), margin);
}

#[test]
fn mountain_car_ends_at_0_5_m_unless_it_moves_back() {
    let there = |s: &[f64]| s[0] >= 0.5 && s[1] >= 0.0;
    check_goal("MountainCar", &[0.45, -0.07], &[0.55, 0.07], |s| (there(s), there(s)), |s| s[0] - 0.5);
}

#[test]
fn acrobot_ends_when_its_tip_is_a_link_above_the_joint() {
    let height = |s: &[f64]| -s[0].cos() - (s[0] + s[1]).cos() - 1.0;
    check_goal(
        "Acrobot",
        &[-3.1, -3.1, -4.0, -4.0],
        &[3.1, 3.1, 4.0, 4.0],
        |s| (height(s) > 0.0, height(s) > 0.0),
        height,
    );
}

#[test]
fn pendulum_is_near_upright_within_a_third_of_pi_and_never_ends() {
    // `near` uses the cosine, so that the angle need not be wrapped.
    let near = |s: &[f64]| s[0].cos() - 0.5;
    check_goal("Pendulum", &[-20.0, -8.0], &[20.0, 8.0], |s| (false, near(s) > 0.0), near);
}
