//! A server with task folders supports everything that it supports for built-in environments.

use super::{CART, TASK, folder};
use crate::{
    common::{
        self,
        server::{self, Actor, Server, Session, doubles, floats, open, parameters},
    },
    dm_env_rpc::client::{Agent, double, settings, text, vector},
};
use perturb::proto::{Open, Reset, Version};
use std::fs;

#[tokio::test]
async fn folders_are_listed_after_the_built_in_environments() {
    let server = Server::with_folders(&[]);
    let served = server::catalogue(server.tcp()).await;
    let names: Vec<&str> = served.iter().map(|environment| environment.name.as_str()).collect();
    assert_eq!(names, common::catalogue().names().collect::<Vec<_>>());
    let quadruped = &served[names.len() - 2];
    assert_eq!(quadruped.name, "Quadruped");
    assert_eq!(quadruped.model_hash.len(), 64);
    assert_eq!(quadruped.heatmap_axes, ["mass", "friction"]);
    let applied: Vec<&str> = quadruped.applied.iter().map(|quantity| quantity.name.as_str()).collect();
    assert_eq!(applied, ["mass", "friction", "strength", "front_left_mass"]);
}

#[tokio::test]
async fn a_folder_is_opened_edited_drawn_saved_and_restored() {
    let server = Server::with_folders(&[]);
    for name in ["Quadruped", "ReachingArm"] {
        let environment = server::environment(server.tcp(), name).await;
        let actor = Actor::new(&environment, 3);
        let (mut session, opened) = Session::open(server.tcp(), open(name, 3, 5)).await;
        assert_eq!(opened.environment.as_ref(), Some(&environment));
        session.play(actor, 0, 7).await;
        let first = &environment.parameters[0];
        let value = first.extreme.as_ref().unwrap().intervals[1].high;
        let edit = Reset { parameters: parameters(&[(&first.name, &[(value, value)])]), ..Reset::default() };
        let started = session.ask(edit).await.started;
        assert_eq!(started.len(), 3);
        for receipt in started.iter().filter_map(|start| start.receipt.as_ref()) {
            assert_eq!((receipt.requested[0], receipt.applied[0]), (value, value), "the edit took effect");
        }
        let snapshots = session.snapshot(&[]).await;
        let picture = session.render(0, (96, 64)).await;
        assert!(picture.iter().any(|&byte| byte != picture[0]), "{name}: the picture shows something");
        let after = session.play(actor, 7, 30).await;
        assert_ne!(session.render(0, (96, 64)).await, picture, "{name}: it moved");
        session.restore(&[], snapshots).await;
        assert_eq!(session.render(0, (96, 64)).await, picture);
        assert_eq!(session.play(actor, 7, 30).await, after, "{name}: the same bytes");
    }
}

#[tokio::test]
async fn observed_parameters_stand_at_the_end_of_observations() {
    let server = Server::with_folders(&[]);
    let environment = server::environment(server.tcp(), "ReachingArm").await;
    let seen = Open { observe_parameters: true, version: Version::Default.into(), ..open("ReachingArm", 1, 1) };
    let (_, opened) = Session::open(server.tcp(), seen).await;
    let plain = environment.observation.len();
    let observation = floats(&opened.observations);
    assert_eq!(observation.len(), plain + environment.parameters.len());
    for (value, p) in observation[plain..].iter().zip(&environment.parameters) {
        let (low, high) = (p.extreme.as_ref().unwrap().intervals[0].low, p.extreme.as_ref().unwrap().intervals[1].high);
        let expected = 2.0 * (p.default_value - low) / (high - low) - 1.0;
        assert!((f64::from(*value) - expected).abs() < 1e-6, "{}", p.name);
    }
}

#[tokio::test]
async fn a_folder_is_a_world_of_dm_env_rpc() {
    let server = Server::with_folders(&[]);
    let settings = settings("ReachingArm", [("version", text("R")), ("lower_mass", double(1.5))]);
    let (mut agent, _) = Agent::in_world(server.tcp(), settings).await;
    let first = agent.step(vector(&[0.0, 0.0])).await;
    assert_eq!(first.observation.len(), server::environment(server.tcp(), "ReachingArm").await.observation.len());
    assert_eq!(agent.read("parameters.lower_mass").await, double(1.5));
    assert_eq!(agent.read("applied.lower_mass").await, double(1.5));
}

#[tokio::test]
async fn tasks_may_stand_in_the_file_of_settings() {
    let task = folder(&[("task.toml", TASK), ("cart.xml", CART)]);
    let file = task.path().join("settings.toml");
    fs::write(&file, format!("tasks = [{:?}]\n", task.path())).unwrap();
    let server = Server::start(&["--config", file.to_str().unwrap()]);
    assert!(server::catalogue(server.tcp()).await.iter().any(|environment| environment.name == "CartAndPole"));
}

#[tokio::test]
async fn sessions_keep_what_was_loaded_when_files_change() {
    let task = folder(&[("task.toml", TASK), ("cart.xml", CART)]);
    let server = Server::start(&["--task", task.path().to_str().unwrap()]);
    let environment = server::environment(server.tcp(), "CartAndPole").await;
    let run = async || {
        let (mut session, _) = Session::open(server.tcp(), open("CartAndPole", 2, 1)).await;
        session.ask(Reset { states: doubles(&[0.1; 8]), ..Reset::default() }).await;
        session.play(Actor::new(&environment, 2), 0, 20).await
    };
    let before = run().await;
    fs::write(task.path().join("cart.xml"), CART.replace("gear=\"20\"", "gear=\"30\"")).unwrap();
    assert_eq!(run().await, before);
    server::until("the server notices", async || server.log().contains("the files of this task changed")).await;
    assert_eq!(run().await, before, "until it is restarted");
}

#[tokio::test]
async fn declared_disturbances_are_parameters_of_every_session() {
    const DECLARED: &str = r#"
[disturbances]
action_delay = { random = [0, 2.5], extreme = [[0, 0], [2.5, 5]] }
sensor_noise = { random = [0.0, 0.05], extreme = [[0.0, 0.0], [0.05, 0.1]] }
"#;
    let task = folder(&[("task.toml", &format!("{TASK}{DECLARED}")), ("cart.xml", CART)]);
    let path = task.path().to_str().unwrap();
    let server = Server::start(&["--task", path]);
    let environment = server::environment(server.tcp(), "CartAndPole").await;
    let names: Vec<&str> = environment.parameters.iter().map(|parameter| parameter.name.as_str()).collect();
    let expected = [
        "pole_mass",
        "action_delay",
        "action_hold",
        "action_noise",
        "action_scale",
        "push",
        "push_interval",
        "sensor_delay",
        "sensor_noise",
        "sensor_dropout",
        "change_at",
        "change_every",
        "change_probability",
        "changed_pole_mass",
    ];
    assert_eq!(names, expected);
    assert!(environment.disturbances.is_empty(), "nothing is left beside the parameters");
    let drawn = async |version: Version| {
        let open = Open { version: version.into(), ..open("CartAndPole", 64, 1) };
        let (_, opened) = Session::open(server.tcp(), open).await;
        assert_eq!(opened.environment.as_ref(), Some(&environment));
        let receipts = opened.started.iter().map(|start| start.receipt.clone().unwrap());
        receipts.map(|receipt| (receipt.requested[1], receipt.requested[8])).collect::<Vec<_>>()
    };
    assert!(drawn(Version::Default).await.iter().all(|&drawn| drawn == (0.0, 0.0)));
    let is_in =
        |(delay, noise): (f64, f64), delays: &[f64], low, high| delays.contains(&delay) && (low..high).contains(&noise);
    assert!(drawn(Version::Random).await.iter().all(|&drawn| is_in(drawn, &[0.0, 1.0, 2.0], 0.0, 0.05)));
    assert!(drawn(Version::Extreme).await.iter().all(|&drawn| is_in(drawn, &[3.0, 4.0, 5.0], 0.05, 0.1)));
    let seen = Open { observe_parameters: true, version: Version::Default.into(), ..open("CartAndPole", 1, 1) };
    let (_, opened) = Session::open(server.tcp(), seen).await;
    let observation = floats(&opened.observations);
    assert_eq!(observation[observation.len() - 13], -1.0, "a delay of 0 is the least of R and E");
    let checked = server::command().args(["--check", "--task", path]).output().unwrap();
    let printed = String::from_utf8(checked.stdout).unwrap();
    let line = "  disturbance   action_delay (1): D 0, R [0, 2.5], E [0, 0] and [2.5, 5], within [0, 100]: ";
    assert!(printed.contains(line), "{printed}");
}

#[tokio::test]
async fn pictures_show_the_lengths_of_the_episode() {
    let server = Server::with_folders(&[]);
    let environment = server::environment(server.tcp(), "StretchedArm").await;
    let (mut session, _) = Session::open(server.tcp(), open("StretchedArm", 1, 1)).await;
    let states = doubles(&vec![0.0; environment.state.len()]);
    let mut pictures = Vec::new();
    for length in [0.35, 0.25, 0.45, 0.25, 0.35] {
        let parameters = parameters(&[("upper_length", &[(length, length)])]);
        let started = session.ask(Reset { parameters, states: states.clone(), ..Reset::default() }).await.started;
        let receipt = started[0].receipt.as_ref().unwrap();
        let applied = receipt.applied[environment.parameters.len() - 1];
        assert!((applied - length).abs() < 1e-14, "{applied} for {length}");
        pictures.push(session.render(0, (160, 120)).await);
    }
    assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2] && pictures[0] != pictures[2]);
    assert!(pictures[0] == pictures[4] && pictures[1] == pictures[3]);
}
