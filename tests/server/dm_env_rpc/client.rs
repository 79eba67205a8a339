//! A client of dm_env_rpc, built on the generated code.

use crate::common::server::{self, within};
use perturb::proto::dm_env_rpc::v1::{
    self as rpc, ActionObservationSpecs, EnvironmentRequest, EnvironmentResponse, StepResponse, Tensor,
    environment_client::EnvironmentClient,
    environment_request::Payload as Request,
    environment_response::Payload as Response,
    extensions::properties::{self, PropertyRequest, PropertyResponse, property_request, property_response},
    tensor,
};
use prost::Message;
use prost_types::Any;
use std::collections::BTreeMap;
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Code, Status, Streaming, transport::Channel};

pub const ACTION: u64 = 1;
/// The uids of all observations: observation, reward, truncated, success, diverged.
pub const ALL: [u64; 5] = [1, 2, 3, 4, 5];
pub const PROPERTIES: &str = "type.googleapis.com/dm_env_rpc.v1.extensions.properties.PropertyRequest";

pub type Settings = BTreeMap<String, Tensor>;

/// A client's stream.
pub struct Agent {
    requests: Option<tokio::sync::mpsc::Sender<EnvironmentRequest>>,
    responses: Streaming<EnvironmentResponse>,
}

impl Agent {
    /// Starts a stream on a new connection.
    pub async fn connect(address: &str) -> Self {
        Self::start(&mut EnvironmentClient::new(server::channel(address).await)).await.unwrap()
    }

    /// Starts a stream on an existing connection.
    pub async fn start(client: &mut EnvironmentClient<Channel>) -> Result<Self, Status> {
        Self::show(client, None).await
    }

    /// Like [`Agent::start`], with a token.
    pub async fn show(client: &mut EnvironmentClient<Channel>, token: Option<&str>) -> Result<Self, Status> {
        let (requests, receiver) = tokio::sync::mpsc::channel(1024);
        let mut call = tonic::Request::new(ReceiverStream::new(receiver));
        if let Some(token) = token {
            call.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
        }
        let responses = within(client.process(call)).await?.into_inner();
        Ok(Self { requests: Some(requests), responses })
    }

    /// Starts a stream, makes a world and joins it.
    pub async fn in_world(address: &str, settings: Settings) -> (Self, String) {
        let mut agent = Self::connect(address).await;
        let world = agent.create(settings).await;
        agent.join(&world).await;
        (agent, world)
    }

    pub async fn send(&self, payload: Option<Request>) {
        // An error is ignored: if the stream has ended, receiving returns the reason.
        let _ = within(self.requests.as_ref().unwrap().send(EnvironmentRequest { payload })).await;
    }

    pub fn close(&mut self) {
        self.requests = None;
    }

    pub async fn receive(&mut self) -> Result<Option<EnvironmentResponse>, Status> {
        within(self.responses.message()).await
    }

    /// Waits for the end of the stream, and returns its status.
    pub async fn end(&mut self) -> Status {
        loop {
            match self.receive().await {
                Ok(Some(_)) => {}
                Ok(None) => return Status::ok(""),
                Err(status) => return status,
            }
        }
    }

    pub async fn ask(&mut self, request: Request) -> Response {
        self.send(Some(request)).await;
        self.receive().await.unwrap().expect("the stream ended").payload.expect("a response is never empty")
    }

    /// Sends a request that must be refused. Returns the code and the message.
    pub async fn refused(&mut self, request: Request) -> (Code, String) {
        match self.ask(request).await {
            Response::Error(status) => (Code::from_i32(status.code), status.message),
            other => panic!("was not refused but answered by {other:?}"),
        }
    }

    pub async fn create(&mut self, settings: Settings) -> String {
        match self.ask(create(settings)).await {
            Response::CreateWorld(response) => response.world_name,
            other => panic!("create_world was answered by {other:?}"),
        }
    }

    pub async fn join(&mut self, world: &str) -> ActionObservationSpecs {
        match self.ask(join(world)).await {
            Response::JoinWorld(response) => response.specs.unwrap(),
            other => panic!("join_world was answered by {other:?}"),
        }
    }

    /// Takes a step and requests all observations.
    pub async fn step(&mut self, action: Tensor) -> Seen {
        match self.ask(step(action)).await {
            Response::Step(response) => Seen::of(response),
            other => panic!("step was answered by {other:?}"),
        }
    }

    pub async fn reset(&mut self, settings: Settings) -> ActionObservationSpecs {
        match self.ask(Request::Reset(rpc::ResetRequest { settings })).await {
            Response::Reset(response) => response.specs.unwrap(),
            other => panic!("reset was answered by {other:?}"),
        }
    }

    pub async fn reset_world(&mut self, world: &str, settings: Settings) {
        let response = self.ask(reset_world(world, settings)).await;
        assert!(matches!(response, Response::ResetWorld(_)), "reset_world was answered by {response:?}");
    }

    pub async fn leave(&mut self) {
        let response = self.ask(leave()).await;
        assert!(matches!(response, Response::LeaveWorld(_)), "leave_world was answered by {response:?}");
    }

    pub async fn destroy(&mut self, world: &str) {
        let response = self.ask(destroy(world)).await;
        assert!(matches!(response, Response::DestroyWorld(_)), "destroy_world was answered by {response:?}");
    }

    async fn property(&mut self, request: property_request::Payload) -> property_response::Payload {
        match self.ask(property(request)).await {
            Response::Extension(any) => {
                assert!(any.type_url.ends_with("/dm_env_rpc.v1.extensions.properties.PropertyResponse"), "{any:?}");
                PropertyResponse::decode(any.value.as_slice()).unwrap().payload.unwrap()
            }
            other => panic!("a property was answered by {other:?}"),
        }
    }

    pub async fn read(&mut self, key: &str) -> Tensor {
        match self.property(read(key)).await {
            property_response::Payload::ReadProperty(read) => read.value.unwrap(),
            other => panic!("{other:?}"),
        }
    }

    pub async fn write(&mut self, key: &str, value: Tensor) {
        match self.property(write(key, value)).await {
            property_response::Payload::WriteProperty(_) => {}
            other => panic!("{other:?}"),
        }
    }

    pub async fn list(&mut self, key: &str) -> Vec<properties::PropertySpec> {
        match self.property(list(key)).await {
            property_response::Payload::ListProperty(list) => list.values,
            other => panic!("{other:?}"),
        }
    }
}

/// The observations of a step.
#[derive(Debug, Clone, PartialEq)]
pub struct Seen {
    pub state: rpc::EnvironmentStateType,
    pub observation: Vec<f32>,
    pub reward: f32,
    pub truncated: bool,
    pub success: bool,
    pub diverged: bool,
}

impl Seen {
    fn of(response: StepResponse) -> Self {
        let state = response.state();
        assert_eq!(response.observations.keys().copied().collect::<Vec<_>>(), ALL);
        let floats = |uid: u64| match response.observations[&uid].payload.as_ref().unwrap() {
            tensor::Payload::Floats(floats) => floats.array.clone(),
            other => panic!("{other:?}"),
        };
        let bool = |uid: u64| match response.observations[&uid].payload.as_ref().unwrap() {
            tensor::Payload::Bools(bools) => bools.array[0],
            other => panic!("{other:?}"),
        };
        Self {
            state,
            observation: floats(1),
            reward: floats(2)[0],
            truncated: bool(3),
            success: bool(4),
            diverged: bool(5),
        }
    }
}

pub fn create(settings: Settings) -> Request {
    Request::CreateWorld(rpc::CreateWorldRequest { settings })
}

pub fn join(world: &str) -> Request {
    Request::JoinWorld(rpc::JoinWorldRequest { world_name: world.into(), settings: Settings::new() })
}

pub fn step(action: Tensor) -> Request {
    let requested_observations = ALL.to_vec();
    Request::Step(rpc::StepRequest { actions: BTreeMap::from([(ACTION, action)]), requested_observations })
}

pub fn reset_world(world: &str, settings: Settings) -> Request {
    Request::ResetWorld(rpc::ResetWorldRequest { world_name: world.into(), settings })
}

pub fn leave() -> Request {
    Request::LeaveWorld(rpc::LeaveWorldRequest {})
}

pub fn destroy(world: &str) -> Request {
    Request::DestroyWorld(rpc::DestroyWorldRequest { world_name: world.into() })
}

pub fn property(payload: property_request::Payload) -> Request {
    let value = PropertyRequest { payload: Some(payload) }.encode_to_vec();
    Request::Extension(Any { type_url: PROPERTIES.into(), value })
}

pub fn read(key: &str) -> property_request::Payload {
    property_request::Payload::ReadProperty(properties::ReadPropertyRequest { key: key.into() })
}

pub fn write(key: &str, value: Tensor) -> property_request::Payload {
    let write = properties::WritePropertyRequest { key: key.into(), value: Some(value) };
    property_request::Payload::WriteProperty(write)
}

pub fn list(key: &str) -> property_request::Payload {
    property_request::Payload::ListProperty(properties::ListPropertyRequest { key: key.into() })
}

/// Returns the settings of a world: its environment `env_id`, and others by name.
pub fn settings<const N: usize>(env_id: &str, others: [(&str, Tensor); N]) -> Settings {
    let all = [("env_id", text(env_id))].into_iter().chain(others);
    all.map(|(name, tensor)| (name.into(), tensor)).collect()
}

pub fn text(text: &str) -> Tensor {
    scalar(tensor::Payload::Strings(tensor::StringArray { array: vec![text.into()] }))
}

pub fn int64(n: i64) -> Tensor {
    scalar(tensor::Payload::Int64s(tensor::Int64Array { array: vec![n] }))
}

pub fn uint64(n: u64) -> Tensor {
    scalar(tensor::Payload::Uint64s(tensor::Uint64Array { array: vec![n] }))
}

pub fn boolean(x: bool) -> Tensor {
    scalar(tensor::Payload::Bools(tensor::BoolArray { array: vec![x] }))
}

pub fn double(x: f64) -> Tensor {
    scalar(tensor::Payload::Doubles(tensor::DoubleArray { array: vec![x] }))
}

/// Returns a discrete action.
pub fn choice(n: i32) -> Tensor {
    scalar(tensor::Payload::Int32s(tensor::Int32Array { array: vec![n] }))
}

/// Returns a continuous action.
pub fn vector(array: &[f32]) -> Tensor {
    floats(array, &[array.len() as i32])
}

pub fn floats(array: &[f32], shape: &[i32]) -> Tensor {
    let payload = tensor::Payload::Floats(tensor::FloatArray { array: array.to_vec() });
    Tensor { payload: Some(payload), shape: shape.to_vec() }
}

fn scalar(payload: tensor::Payload) -> Tensor {
    Tensor { payload: Some(payload), shape: Vec::new() }
}
