//! Robots that share a simulation do not affect each other, even if MuJoCo raises a fatal error for one of them.

use crate::{
    env::{Action, Environment},
    scene::{Look, ModelView, Scenery},
    tasks::{
        hopper,
        locomotion::{
            Robot, SCENERY, Walker,
            channels::{Names, names},
        },
    },
};
use std::sync::OnceLock;

const NAMES: Names = names!(joints: ["thigh", "leg", "foot"], contacts: ["foot"]);

/// A hopper whose MuJoCo stack is large enough in the air, but too small for contacts with the floor.
static WITH_A_SMALL_STACK: OnceLock<Robot> = OnceLock::new();

fn walker() -> Walker {
    let robot = WITH_A_SMALL_STACK.get_or_init(|| Robot {
        spec: &hopper::SPEC,
        look: Look {
            name: "Hopper",
            mjcf: include_str!("../../../models/hopper.xml").replace("20000", "200").leak(),
            files: &[],
            scenery: Some(Scenery { mjcf: SCENERY, hidden: "floor", colours: &[] }),
            view: ModelView::Beside { followed: "torso", distance: 1.0, height: 1.0 },
        },
        names: NAMES,
        alive: |_| true,
        pristine: OnceLock::new(),
    });
    Walker::new(robot).unwrap()
}

/// Puts the hopper in the air, with its joints within their limits.
fn fly(walker: &mut Walker) {
    walker.reset_to(&[0.0, 5.0, 0.0, -0.5, -0.5, 0.1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
}

fn step(walker: &mut Walker) -> (bool, Vec<f64>) {
    let diverged = walker.step(Action::Continuous(&[0.1, -0.1, 0.2]), &mut [0.0; 5]).diverged;
    let mut state = Vec::new();
    walker.save(&mut state);
    (diverged, state)
}

#[test]
fn a_fatal_error_ends_the_episode_of_one_robot_only() {
    let (mut alone, mut next, mut lands) = (walker(), walker(), walker());
    fly(&mut alone);
    fly(&mut next);
    let flight: Vec<_> = (0..20).map(|_| step(&mut alone)).collect();
    for (diverged, state) in flight {
        fly(&mut lands);
        assert!(!step(&mut lands).0);
        lands.reset_to(&[0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert!(step(&mut lands).0, "it touches the floor, which is fatal");
        assert!(step(&mut lands).0, "it stays diverged until it is reset");
        assert_eq!(step(&mut next), (diverged, state));
        assert!(!diverged);
    }
}
