//! Pictures from a real server. These tests need OpenGL in software: Debian's libegl1 and libgl1-mesa-dri.

use crate::common::server::{self, Actor, Server, Session, catalogue, doubles, open, parameters, refusal};
use bytes::Bytes;
use insta::assert_snapshot;
use perturb::{
    proto::{AutoresetMode, Environment, Open, Render, Reset, Version, session_response::Response},
    tasks,
};
use std::{
    collections::HashSet,
    f64::consts::{FRAC_PI_2, PI},
    process::Command,
    sync::Arc,
};
use tonic::Code;

const SMALL: (u32, u32) = (120, 120);
const ROBOTS: [&str; 2] = ["Hopper", "HalfCheetah"];

fn robots() -> impl Iterator<Item = &'static str> {
    ROBOTS.into_iter().filter(|name| tasks::catalogue().find(name).is_ok())
}

fn start() -> Server {
    Server::start(&["--workers", "2"])
}

/// Returns an `open` in version D without autoreset.
fn plain(environment: &str, n: u32) -> Open {
    let (version, mode) = (Version::Default.into(), AutoresetMode::Disabled.into());
    Open { version, autoreset_mode: mode, ..open(environment, n, 3) }
}

async fn session(server: &Server, environment: &str, n: u32) -> Session {
    Session::open(server.unix(), plain(environment, n)).await.0
}

/// Returns a picture of one environment in an exact state.
async fn at(server: &Server, environment: &str, state: &[f64], size: (u32, u32)) -> Bytes {
    let mut session = session(server, environment, 1).await;
    session.ask(Reset { states: doubles(state), ..Reset::default() }).await;
    session.render(0, size).await
}

/// Returns a robot's state at this x, at rest in its initial pose.
fn robot_state(name: &str, x: f64) -> Vec<f64> {
    let mut state = vec![0.0; tasks::catalogue().find(name).unwrap().state.len()];
    state[0] = x;
    state
}

/// Finds the pixels for which `is` is true. Returns their centre, right and up from the lower left corner, 0 … 1, and
/// their number.
fn centre(pixels: &[u8], (width, height): (u32, u32), is: impl Fn([u8; 3]) -> bool) -> (f64, f64, usize) {
    let (mut x, mut y, mut n) = (0.0, 0.0, 0);
    for (i, &pixel) in pixels.as_chunks::<3>().0.iter().enumerate() {
        if is(pixel) {
            x += ((i as u32 % width) as f64 + 0.5) / f64::from(width);
            y += 1.0 - ((i as u32 / width) as f64 + 0.5) / f64::from(height);
            n += 1;
        }
    }
    (x / n as f64, y / n as f64, n)
}

fn orange([r, g, b]: [u8; 3]) -> bool {
    (r, g, b) == (230, 159, 0)
}

fn blue([r, g, b]: [u8; 3]) -> bool {
    (r, g, b) == (0, 114, 178)
}

fn vermillion([r, g, b]: [u8; 3]) -> bool {
    (r, g, b) == (213, 94, 0)
}

/// Whether a colour is strong. Only robots have strong colours: floor and sky are pale, and the line at the goal is
/// green.
fn strong([r, g, b]: [u8; 3]) -> bool {
    r.abs_diff(b) > 110 && g < r.max(b)
}

#[tokio::test]
async fn every_environment_is_drawn_in_the_size_that_was_asked_for() {
    let server = start();
    for environment in catalogue(server.unix()).await {
        let name = &environment.name;
        let mut session = session(&server, name, 2).await;
        for (asked, given) in
            [((0, 0), (480, 480)), ((0, 100), (480, 100)), ((16, 33), (16, 33)), ((301, 17), (301, 17))]
        {
            let (width, height) = asked;
            let picture = session.ask(Render { slot: 1, width, height }).await;
            assert_eq!((picture.width, picture.height), given, "{name}");
            assert_eq!(picture.pixels.len(), 3 * (given.0 * given.1) as usize, "{name}");
            let colours: HashSet<&[u8; 3]> = picture.pixels.as_chunks::<3>().0.iter().collect();
            assert!(colours.len() > 5, "{name} in {given:?} has {} colours", colours.len());
        }
    }
}

#[tokio::test]
async fn pictures_differ_exactly_as_states_do() {
    let (server, other) = (start(), start());
    for environment in catalogue(server.unix()).await {
        let name = &environment.name;
        let (mut one, mut two) = (session(&server, name, 3).await, session(&other, name, 1).await);
        let pictures = [one.render(0, SMALL).await, one.render(1, SMALL).await, one.render(2, SMALL).await];
        assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2], "{name}: other states, the same picture");
        // A picture must not depend on earlier pictures: not on the first, nor on one by another camera, nor on a
        // larger one.
        assert_eq!(one.render(0, SMALL).await, pictures[0], "{name}: the first picture");
        let large = one.render(1, (500, 400)).await;
        assert_eq!(one.render(1, SMALL).await, pictures[1], "{name}: after a larger one");
        assert_eq!(one.render(1, (500, 400)).await, large, "{name}");
        let snapshot = one.snapshot(&[0, 1, 0]).await;
        two.restore(&[1], snapshot).await;
        assert_eq!(two.render(0, SMALL).await, pictures[1], "{name}: the same state in another server");
        let actions = Actor::new(&environment, 3).actions(0);
        one.step(actions).await;
        assert_ne!(one.render(1, SMALL).await, pictures[1], "{name}: a step cannot be seen");
    }
}

#[tokio::test]
async fn drawing_changes_nothing() {
    let server = start();
    for environment in catalogue(server.unix()).await {
        let (mut drawn, _) = Session::open(server.unix(), open(&environment.name, 5, 11)).await;
        let (mut left_alone, _) = Session::open(server.unix(), open(&environment.name, 5, 11)).await;
        let actor = Actor::new(&environment, 5);
        for t in 0..60 {
            if t % 3 == 0 {
                drawn.render((t % 5) as u32, (40, 30)).await;
            }
            let (a, b) = (drawn.step(actor.actions(t)).await, left_alone.step(actor.actions(t)).await);
            assert_eq!(a, b, "{} at step {t}", environment.name);
        }
        assert_eq!(drawn.snapshot(&[]).await, left_alone.snapshot(&[]).await, "{}", environment.name);
    }
}

#[tokio::test]
async fn up_is_up_and_right_is_right() {
    let server = start();
    let cart_pole = |x: f64, angle: f64| [x, 0.0, angle, 0.0];
    let pixels = at(&server, "CartPole", &cart_pole(0.0, 0.2), SMALL).await;
    let ((pole_x, pole_y, _), (cart_x, cart_y, _)) = (centre(&pixels, SMALL, orange), centre(&pixels, SMALL, blue));
    assert!(pole_y > cart_y + 0.02, "the pole stands on the cart: {pole_y} {cart_y}");
    assert!(pole_x > cart_x + 0.01, "a positive angle leans to the right: {pole_x} {cart_x}");
    let right = at(&server, "CartPole", &cart_pole(1.5, 0.2), SMALL).await;
    assert!(centre(&right, SMALL, blue).0 > cart_x + 0.2);

    let (left, right) =
        (at(&server, "MountainCar", &[-1.1, 0.0], SMALL).await, at(&server, "MountainCar", &[0.4, 0.0], SMALL).await);
    let valley = at(&server, "MountainCar", &[-0.52, 0.0], SMALL).await;
    let ((left_x, _, _), (right_x, right_y, _)) = (centre(&left, SMALL, blue), centre(&right, SMALL, blue));
    assert!(left_x < 0.3 && right_x > 0.7, "{left_x} {right_x}");
    assert!(right_y > centre(&valley, SMALL, blue).1 + 0.2);

    // The two links hang down, stand upright, and point to the right. The angle is measured from hanging,
    // anticlockwise.
    for (angle, x, y) in [(0.0, 0.0, -1.0), (PI, 0.0, 1.0), (FRAC_PI_2, 1.0, 0.0)] {
        let pixels = at(&server, "Acrobot", &[angle, 0.0, 0.0, 0.0], SMALL).await;
        let (tip_x, tip_y, _) = centre(&pixels, SMALL, orange);
        let (is_x, is_y) = (tip_x - 0.5, tip_y - 0.5);
        assert!((is_x - 0.227 * x).abs() < 0.02 && (is_y - 0.227 * y).abs() < 0.02, "{angle}: {is_x} {is_y}");
    }
    // The angle is measured from upright, anticlockwise.
    for (angle, x, y) in [(0.0, 0.0, 1.0), (PI, 0.0, -1.0), (FRAC_PI_2, -1.0, 0.0)] {
        let pixels = at(&server, "Pendulum", &[angle, 0.0], SMALL).await;
        let (rod_x, rod_y, _) = centre(&pixels, SMALL, vermillion);
        let (is_x, is_y) = (rod_x - 0.5, rod_y - 0.5);
        assert!((is_x - 0.14 * x).abs() < 0.03 && (is_y - 0.14 * y).abs() < 0.03, "{angle}: {is_x} {is_y}");
    }
    for name in robots() {
        let pixels = at(&server, name, &robot_state(name, 0.0), SMALL).await;
        let row = |y: u32| pixels.as_chunks::<3>().0[(y * SMALL.0) as usize..][..SMALL.0 as usize].to_vec();
        let bluish = |row: &[[u8; 3]]| row.iter().filter(|[r, _, b]| *b > r.saturating_add(30)).count();
        assert!(bluish(&row(2)) > 100, "{name}: the sky is above");
        assert!(bluish(&row(SMALL.1 - 3)) < 20, "{name}: the floor is below");
    }
    if tasks::catalogue().find("HalfCheetah").is_ok() {
        let pixels = at(&server, "HalfCheetah", &robot_state("HalfCheetah", 0.0), SMALL).await;
        let (back, _, _) = centre(&pixels, SMALL, |pixel| strong(pixel) && pixel[2] > pixel[0]);
        let (front, _, _) = centre(&pixels, SMALL, |pixel| strong(pixel) && pixel[0] > pixel[2]);
        assert!(back < 0.45 && front > 0.55, "it runs to the right: {back} {front}");
    }
}

#[tokio::test]
async fn lengths_can_be_seen() {
    let server = start();
    let high = |pixels: &[u8], is: fn([u8; 3]) -> bool| centre(pixels, SMALL, is).2;
    for (name, colour, longer) in
        [("CartPole", orange as fn([u8; 3]) -> bool, 1.0), ("Acrobot", orange, 1.5), ("Pendulum", vermillion, 1.5)]
    {
        let mut counts = Vec::new();
        for length in [0.5 * longer, longer] {
            let open = Open { parameters: parameters(&[("length", &[(length, length)])]), ..plain(name, 1) };
            let (mut session, _) = Session::open(server.unix(), open).await;
            counts.push(high(&session.render(0, SMALL).await, colour) as f64);
        }
        assert!(counts[1] > 1.6 * counts[0], "{name}: {counts:?}");
    }
    // Absurd lengths also work: a pole of a hundred times the length is completely visible.
    let open = Open { parameters: parameters(&[("length", &[(100.0, 100.0)])]), ..plain("CartPole", 1) };
    let (mut session, _) = Session::open(server.unix(), open).await;
    let (_, y, _) = centre(&session.render(0, SMALL).await, SMALL, |[r, g, b]| r > g && g > b && b < 200);
    assert!((0.3..0.7).contains(&y), "{y}");
}

#[tokio::test]
async fn the_camera_follows_a_robot_wherever_it_runs() {
    let server = start();
    for name in robots() {
        let mut session = session(&server, name, 1).await;
        let in_view = |pixels: &[u8]| {
            let (x, y, n) = centre(pixels, SMALL, strong);
            assert!((0.3..0.7).contains(&x) && (0.2..0.8).contains(&y), "{name} is at {x}, {y} of the picture");
            n as f64
        };
        let start = at(&server, name, &robot_state(name, 0.0), SMALL).await;
        let at_start = in_view(&start);
        assert!(at_start > 150.0, "{name}: {at_start} pixels");
        for x in [1.3, 19.9, 77.7, -10_000.0] {
            let mut state = robot_state(name, x);
            state[1] = 0.3; // in the air
            session.ask(Reset { states: doubles(&state), ..Reset::default() }).await;
            let n = in_view(&session.render(0, SMALL).await);
            assert!((0.7..1.4).contains(&(n / at_start)), "{name} at {x} m: {n} pixels, {at_start} at the start");
            let again = at(&server, name, &robot_state(name, 0.0), SMALL).await;
            assert!(again == start, "{name}: the place of the last picture shows in this one");
        }
        // The robot takes a hundred steps and moves forward.
        let (mut session, opened) =
            Session::open(server.unix(), Open { autoreset_mode: AutoresetMode::NextStep.into(), ..plain(name, 1) })
                .await;
        let environment = opened.environment.unwrap();
        let mut state = robot_state(name, 0.0);
        state[environment.state.len() / 2] = 6.0; // m/s
        session.ask(Reset { states: doubles(&state), ..Reset::default() }).await;
        for t in 0..100 {
            session.step(Actor::new(&environment, 1).actions(t)).await;
            if t % 10 == 9 {
                in_view(&session.render(0, SMALL).await);
            }
        }
    }
}

#[tokio::test]
async fn sessions_draw_side_by_side() {
    let server = start();
    let environments = catalogue(server.unix()).await;
    let mut expected = Vec::new();
    for environment in &environments {
        let mut session = session(&server, &environment.name, 4).await;
        let mut pictures = Vec::new();
        for slot in 0..4 {
            pictures.push(session.render(slot, (64 + 8 * slot, 80)).await);
        }
        expected.push(pictures);
    }
    let server = Arc::new(server);
    let mut tasks = tokio::task::JoinSet::new();
    for (environment, expected) in environments.into_iter().zip(expected) {
        for _ in 0..2 {
            let (server, name, expected) = (Arc::clone(&server), environment.name.clone(), expected.clone());
            tasks.spawn(async move {
                let mut session = session(&server, &name, 4).await;
                let slots: Vec<u32> = (0..4).cycle().take(12).collect();
                for &slot in &slots {
                    session.send(Render { slot, width: 64 + 8 * slot, height: 80 }).await;
                }
                for slot in slots {
                    let Some(Response::Render(picture)) = session.receive().await.unwrap().unwrap().response else {
                        panic!("{name} was not drawn")
                    };
                    assert!(picture.pixels == expected[slot as usize], "{name}: another's picture");
                }
            });
        }
    }
    while let Some(done) = tasks.join_next().await {
        done.unwrap();
    }
}

/// The order of replies shows who waits. If the server's transport thread or its only worker drew the pictures, at most
/// one step would be taken for each picture. Another thread receives the large pictures.
#[tokio::test]
async fn nobody_waits_for_anothers_pictures() {
    const PICTURES: usize = 6;
    let server = Server::start(&["--workers", "1"]);
    let cart_pole = server::environment(server.unix(), "CartPole").await;
    // A robot takes long to draw. Without MuJoCo, a large picture is used instead.
    let (name, side) = robots().next().map_or(("CartPole", 2048), |robot| (robot, 1024));
    let mut stepping = Session::open(server.unix(), open("CartPole", 1, 1)).await.0;
    let address = server.unix().to_owned();
    let (ready, begin) = std::sync::mpsc::channel();
    let pictures = std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let mut drawing = Session::open(&address, plain(name, 1)).await.0;
            drawing.render(0, (side, side)).await; // excludes the setup time of the first picture
            ready.send(()).unwrap();
            for _ in 0..PICTURES {
                drawing.send(Render { slot: 0, width: side, height: side }).await;
            }
            for _ in 0..PICTURES {
                let response = drawing.receive().await.unwrap().unwrap().response;
                assert!(matches!(response, Some(Response::Render(_))), "not drawn");
            }
        });
    });
    begin.recv().unwrap();
    let mut steps = 0;
    while !pictures.is_finished() {
        stepping.step(Actor::new(&cart_pole, 1).actions(steps)).await;
        steps += 1;
    }
    pictures.join().unwrap();
    assert!(steps > 3 * PICTURES as u64, "{name}: {steps} steps beside {PICTURES} pictures");
}

#[tokio::test]
async fn bad_requests_are_refused_and_change_nothing() {
    let server = start();
    let mut session = Session::connect(server.unix()).await;
    let render = |slot, width, height| Render { slot, width, height };
    let mut refusals = refusal(session.refused(render(0, 0, 0)).await);
    session.ask(plain("CartPole", 3)).await;
    let before = session.render(2, SMALL).await;
    for wrong in [
        render(3, 0, 0),
        render(u32::MAX, 0, 0),
        render(0, 15, 0),
        render(0, 0, 2049),
        render(0, 65_536, 65_536),
        render(0, 480, u32::MAX),
    ] {
        refusals += &refusal(session.refused(wrong).await);
    }
    assert_snapshot!(refusals, @r"
    FailedPrecondition: render came before open; send open first
    InvalidArgument: render.slot is 3; expected a slot of the batch, 0 … 2
    InvalidArgument: render.slot is 4294967295; expected a slot of the batch, 0 … 2
    InvalidArgument: render.width is 15; expected 16 … 2048 pixels, or 0 for 480
    InvalidArgument: render.height is 2049; expected 16 … 2048 pixels, or 0 for 480
    InvalidArgument: render.width is 65536; expected 16 … 2048 pixels, or 0 for 480
    InvalidArgument: render.height is 4294967295; expected 16 … 2048 pixels, or 0 for 480
    ");
    assert_eq!(session.render(2, SMALL).await, before);
}

/// Starts a server without OpenGL, which `switch` disables by settings of the operating system.
fn server_without_gl(switch: impl FnOnce(&mut Command, &std::path::Path)) -> Server {
    let directory = tempfile::tempdir().unwrap();
    let mut command = server::command();
    command.args(["--listen", &format!("unix:{}", directory.path().join("socket").display())]);
    switch(&mut command, directory.path());
    Server::spawn(command, directory, 1)
}

#[tokio::test]
async fn without_opengl_the_server_runs_and_says_what_is_missing() {
    // OpenGL fails first without a driver, then with a library that cannot be loaded.
    let no_driver = server_without_gl(|command, _| {
        command.env("__EGL_VENDOR_LIBRARY_FILENAMES", "/nowhere.json");
    });
    let no_library = server_without_gl(|command, directory| {
        std::fs::write(directory.join("libEGL.so.1"), "").unwrap();
        command.env("LD_LIBRARY_PATH", directory);
    });
    for server in [no_driver, no_library] {
        for environment in catalogue(server.unix()).await {
            let Environment { name, .. } = &environment;
            let mut session = session(&server, name, 1).await;
            for t in 0..2 {
                if ROBOTS.contains(&name.as_str()) {
                    let (code, message) = session.refused(Render::default()).await;
                    assert_eq!(code, Code::FailedPrecondition, "{message}");
                    for part in [name.as_str(), "OpenGL", "libegl1", "libgl1-mesa-dri"] {
                        assert!(message.contains(part), "{message}");
                    }
                } else {
                    session.render(0, SMALL).await;
                }
                session.step(Actor::new(&environment, 1).actions(t)).await;
            }
        }
    }
}
