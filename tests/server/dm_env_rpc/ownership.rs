//! Ownership of worlds in dm_env_rpc: their names, and who may reset and destroy them.

use super::client::{Agent, Settings, boolean, choice, create, destroy, double, join, reset_world, settings, text};
use crate::common::server::{Server, channel, refusal};
use insta::assert_snapshot;
use perturb::proto::dm_env_rpc::v1::environment_client::EnvironmentClient;
use tonic::Code;

#[tokio::test]
async fn a_name_cannot_be_guessed_unless_it_was_asked_for() {
    let server = Server::start(&["--max-envs", "3"]);
    let mut agent = Agent::connect(server.tcp()).await;
    let mut random = Vec::new();
    for _ in 0..2 {
        let name = agent.create(settings("CartPole", [])).await;
        let digits = name.strip_prefix("CartPole-").expect("which environment it is").to_owned();
        assert!(digits.len() == 32 && digits.bytes().all(|digit| digit.is_ascii_hexdigit()), "128 bits: {name}");
        agent.destroy(&name).await;
        random.push(digits);
    }
    assert_ne!(random[0], random[1]);

    let named = |name| settings("CartPole", [("world_name", text(name))]);
    assert_eq!(agent.create(named("pole_2.a-B")).await, "pole_2.a-B");
    let mut other = Agent::connect(server.tcp()).await;
    let mut refusals = String::new();
    for _ in 0..5 {
        refusals = refusal(other.refused(create(named("pole_2.a-B"))).await);
    }
    let long = "x".repeat(65);
    for name in ["", "a b", "a\n", "é", "../x", &long] {
        refusals += &refusal(other.refused(create(named(name))).await);
    }
    for wrong in [("world_name", double(1.0)), ("shared", text("yes"))] {
        refusals += &refusal(other.refused(create(settings("CartPole", [wrong]))).await);
    }
    assert_snapshot!(refusals);
    other.create(settings("CartPole", [])).await;
    other.create(settings("CartPole", [])).await; // refused requests have left nothing behind
    agent.destroy("pole_2.a-B").await;
    assert_eq!(other.create(named("pole_2.a-B")).await, "pole_2.a-B", "a name is free again with its world");
}

#[tokio::test]
async fn world_is_changed_only_by_its_maker_and_its_agent() {
    let server = Server::start(&[]);
    let (mut maker, mut agent) = (Agent::connect(server.tcp()).await, Agent::connect(server.tcp()).await);
    let mut stranger = Agent::connect(server.unix()).await;
    let world = maker.create(settings("CartPole", [])).await;
    let heavy = || Settings::from([("mass".into(), double(0.3))]);
    maker.reset_world(&world, heavy()).await;
    agent.join(&world).await;
    agent.reset_world(&world, heavy()).await;
    maker.reset_world(&world, heavy()).await;
    for request in [reset_world(&world, heavy()), destroy(&world)] {
        let (code, message) = stranger.refused(request).await;
        assert!(code == Code::PermissionDenied && message.contains("neither the maker nor the agent"), "{message}");
    }
    agent.leave().await;
    for request in [reset_world(&world, heavy()), destroy(&world)] {
        assert_eq!(agent.refused(request).await.0, Code::PermissionDenied, "it has left it");
    }
    // Everybody who knows the name may join the world and be its agent.
    stranger.join(&world).await;
    drop(maker);
    stranger.step(choice(0)).await;
    stranger.reset_world(&world, heavy()).await;
    assert_eq!(agent.refused(reset_world(&world, heavy())).await.0, Code::PermissionDenied);
    assert_eq!(agent.refused(destroy(&world)).await.0, Code::PermissionDenied);
}

#[tokio::test]
async fn a_shared_world_is_everybodys() {
    let server = Server::start(&[]);
    let (mut maker, mut other) = (Agent::connect(server.tcp()).await, Agent::connect(server.tcp()).await);
    let world = maker.create(settings("CartPole", [("shared", boolean(true))])).await;
    other.reset_world(&world, Settings::new()).await;
    other.destroy(&world).await;
    assert_eq!(maker.refused(join(&world)).await.0, Code::NotFound);
}

#[tokio::test]
async fn a_token_does_not_see_anothers_worlds() {
    let directory = tempfile::tempdir().unwrap();
    let file = directory.path().join("tokens.toml");
    let [ann, bob] = ["correct-horse-battery", "staple-correct-horse"];
    let entry = |name, token| format!("[[token]]\nname = \"{name}\"\ntoken = \"{token}\"\nmax_envs = 1\n");
    std::fs::write(&file, entry("ann", ann) + &entry("bob", bob)).unwrap();
    let server = Server::start(&["--tokens", file.to_str().unwrap()]);
    let mut client = EnvironmentClient::new(channel(server.tcp()).await);
    let mut maker = Agent::show(&mut client, Some(ann)).await.unwrap();
    let mut same = Agent::show(&mut client, Some(ann)).await.unwrap();
    let mut other = Agent::show(&mut client, Some(bob)).await.unwrap();
    let mut neighbour = Agent::connect(server.unix()).await;
    let shared = || settings("CartPole", [("world_name", text("pole")), ("shared", boolean(true))]);
    let world = maker.create(shared()).await;
    for request in [join(&world), reset_world(&world, Settings::new()), destroy(&world)] {
        assert_eq!(other.refused(request.clone()).await.0, Code::NotFound);
        assert_eq!(neighbour.refused(request).await.0, Code::NotFound);
    }
    same.reset_world(&world, Settings::new()).await;
    same.join(&world).await;
    let (code, message) = same.refused(create(settings("CartPole", []))).await;
    assert!(code == Code::ResourceExhausted && message.contains("ann"), "its only environment is in use: {message}");
    assert_eq!(other.create(shared()).await, world, "it may use the name, too");
}
