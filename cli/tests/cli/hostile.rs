//! A hostile server sends control sequences in all its texts. None of them reaches the terminal.

use std::pin::Pin;
use std::process::Command;

use perturb_learner::client::Servers;
use perturb_learner::proto::{
    self, Channel, Environment, EpisodeStart, ListEnvironmentsRequest, ListEnvironmentsResponse, Open, Opened, Receipt,
    SessionRequest, SessionResponse,
    perturb_server::{Perturb, PerturbServer},
    session_request::Request as RequestKind,
    session_response::Response as ResponseKind,
};
use rstest::rstest;
use tokio::net::TcpListener;
use tokio::runtime::Builder;
use tokio::sync::oneshot;
use tokio_stream::wrappers::TcpListenerStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::transport::Server;
use tonic::{Code, Request, Response, Status, Streaming};

use crate::common::{addresses, ended, perturb, run, server};

/// A text that colours a terminal, sets its title and clears it.
const HOSTILE: &str = "hostile \u{1b}[31mred\u{1b}]0;title\u{7}\u{9b}2J";

/// How a hostile server refuses sessions.
#[derive(Clone, Copy, Debug)]
enum Refusal {
    /// The call fails.
    Call,
    /// The call is accepted, and its stream ends with an error.
    Stream,
    /// The request to open a session is refused.
    Open,
    /// The session is opened, and every later request is refused.
    Requests,
}

/// A service whose texts are hostile.
struct HostileService {
    catalogue: ListEnvironmentsResponse,
    refusal: Refusal,
    code: Code,
}

fn answer(response: ResponseKind) -> SessionResponse {
    SessionResponse { response: Some(response) }
}

/// Opens a session whose observations are 0 and whose parameters have their defaults.
fn opened(environment: &Environment, open: &Open) -> Opened {
    let size = open.batch_size;
    let requested: Vec<f64> = environment.parameters.iter().map(|parameter| parameter.default_value).collect();
    let receipt = || Receipt { applied: requested.clone(), requested: requested.clone(), model_hash: HOSTILE.into() };
    let start = |slot| EpisodeStart {
        slot,
        episode: Some(proto::Episode { environment_index: slot, ..Default::default() }),
        receipt: Some(receipt()),
    };
    Opened {
        environment: Some(environment.clone()),
        observations: vec![0; size as usize * environment.observation.len() * 4].into(),
        started: (0..size).map(start).collect(),
        autoreset_mode: open.autoreset_mode,
        acts: true,
        ..Opened::default()
    }
}

#[tonic::async_trait]
impl Perturb for HostileService {
    type SessionStream = Pin<Box<dyn Stream<Item = Result<SessionResponse, Status>> + Send>>;

    async fn list_environments(
        &self,
        _: Request<ListEnvironmentsRequest>,
    ) -> Result<Response<ListEnvironmentsResponse>, Status> {
        Ok(Response::new(self.catalogue.clone()))
    }

    async fn session(
        &self,
        requests: Request<Streaming<SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (refusal, code) = (self.refusal, self.code);
        if matches!(refusal, Refusal::Call) {
            return Err(Status::new(code, HOSTILE));
        }
        let environment = self.catalogue.environments[0].clone();
        let responses = requests.into_inner().map(move |request| match (refusal, request?.request) {
            (Refusal::Stream, _) => Err(Status::new(code, HOSTILE)),
            (Refusal::Requests, Some(RequestKind::Open(open))) => {
                Ok(answer(ResponseKind::Opened(opened(&environment, &open))))
            }
            _ => Ok(answer(ResponseKind::Error(proto::Error { code: code.into(), message: HOSTILE.into() }))),
        });
        Ok(Response::new(Box::pin(responses)))
    }
}

/// A running hostile server. It ends when this value is dropped.
struct HostileServer {
    address: String,
    _shutdown: oneshot::Sender<()>,
}

impl HostileServer {
    /// Starts a server with CartPole and with a second environment whose names are hostile, too.
    fn start(refusal: Refusal, code: Code) -> Self {
        let honest = server(1);
        let catalogue = Servers::connect(&addresses(&[honest])).and_then(|servers| servers.catalogue());
        let mut environments = catalogue.expect("a catalogue").environments;
        environments.retain(|environment| environment.name == "CartPole");
        describe(&mut environments[0]);
        environments.push(environments[0].clone());
        rename(&mut environments[1]);
        let server_version = HOSTILE.into();
        let catalogue = ListEnvironmentsResponse { environments, server_version, ..Default::default() };
        let service = HostileService { catalogue, refusal, code };
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        listener.set_nonblocking(true).expect("a listener for tokio");
        let address = listener.local_addr().expect("an address").to_string();
        let (_shutdown, end) = oneshot::channel();
        std::thread::spawn(move || {
            let serve = async {
                let incoming = TcpListenerStream::new(TcpListener::from_std(listener).expect("a listener"));
                let server = Server::builder().add_service(PerturbServer::new(service));
                server.serve_with_incoming_shutdown(incoming, async { drop(end.await) }).await.expect("served");
            };
            Builder::new_current_thread().enable_all().build().expect("a runtime").block_on(serve);
        });
        Self { address, _shutdown }
    }
}

/// Makes the texts of an environment hostile that clients neither look up nor compare.
fn describe(environment: &mut Environment) {
    environment.description = HOSTILE.into();
    for parameter in environment.parameters.iter_mut().chain(&mut environment.disturbances) {
        [parameter.unit, parameter.description] = [HOSTILE; 2].map(Into::into);
    }
    for rule in environment.success.iter_mut().chain(&mut environment.code_success) {
        [rule.description, rule.unit] = [HOSTILE; 2].map(Into::into);
    }
}

/// Makes the names of an environment hostile.
fn rename(environment: &mut Environment) {
    let channel = || Channel { name: HOSTILE.into(), unit: HOSTILE.into(), ..Channel::default() };
    environment.name = HOSTILE.into();
    environment.model_hash = HOSTILE.into();
    environment.observation = vec![channel()];
    let discrete = proto::Discrete { names: vec![HOSTILE.into()] };
    environment.action = Some(proto::ActionSpace { kind: Some(proto::action_space::Kind::Discrete(discrete)) });
    for parameter in environment.parameters.iter_mut().chain(&mut environment.disturbances) {
        parameter.name = HOSTILE.into();
    }
}

/// Runs a command that must print a text of the hostile server. Checks that it prints no control sequence.
#[track_caller]
fn check(mut command: Command) {
    let output = ended(command.spawn().expect("perturb"));
    let printed = String::from_utf8([output.stdout, output.stderr].concat()).expect("UTF-8");
    assert!(printed.contains("\\u{1b}[31mred"), "{command:?}: {printed}");
    let control = printed.chars().find(|character| character.is_control() && *character != '\n');
    assert_eq!(control, None, "{command:?}: {printed:?}");
}

#[test]
fn catalogue_of_a_hostile_server_is_printed_escaped() {
    let hostile = HostileServer::start(Refusal::Call, Code::Internal);
    check(perturb(&["envs", "--server", &hostile.address]));
    check(perturb(&["envs", "--json", "-", "--server", &hostile.address]));
    let out = tempfile::tempdir().expect("a folder");
    let out = out.path().join("run").display().to_string();
    check(perturb(&["train", "--env", "NoSuchEnvironment", "--out", &out, "--server", &hostile.address]));
}

#[rstest]
#[case::call(Refusal::Call, Code::FailedPrecondition)]
#[case::stream(Refusal::Stream, Code::FailedPrecondition)]
#[case::open(Refusal::Open, Code::FailedPrecondition)]
#[case::requests(Refusal::Requests, Code::FailedPrecondition)]
#[case::full(Refusal::Call, Code::ResourceExhausted)]
#[case::lost(Refusal::Requests, Code::Unavailable)]
fn refusals_of_a_hostile_server_are_printed_escaped(#[case] refusal: Refusal, #[case] code: Code) {
    let honest = [server(1)];
    let servers = Servers::connect(&addresses(&honest)).expect("a server");
    let (trained, _) = run(&servers, "environment = 'CartPole'\nepisodes = 2\nnum_envs = 2\nn_steps = 32");
    let trained = trained.path().display().to_string();
    let hostile = HostileServer::start(refusal, code);
    let out = tempfile::tempdir().expect("a folder");
    let [run, film] = ["run", "film.gif"].map(|name| out.path().join(name).display().to_string());
    let server = ["--server", &hostile.address, "--server-wait", "1"];
    for arguments in [
        &["train", "--env", "CartPole", "--episodes", "2", "--out", &run][..],
        &["evaluate", "--checkpoint", &trained, "--episodes", "2"],
    ] {
        check(perturb(&[arguments, &server].concat()));
    }
    check(perturb(&["video", "--checkpoint", &trained, "--out", &film, "--server", &hostile.address]));
}
