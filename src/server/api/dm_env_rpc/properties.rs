//! Properties: named values that are neither actions nor observations. A read of a world's property returns the value
//! in the episode that began last. A write takes effect when the next episode begins.

use super::{
    Error,
    settings::{self, WorldChange},
    tensors,
    world::JoinedWorld,
};
use crate::{
    env::{Catalogue, Distribution, EpisodeId, EpisodeReceipt, shorten},
    proto::dm_env_rpc::v1::{
        DataType, Tensor, TensorSpec,
        extensions::properties::{
            ListPropertyResponse, PropertyRequest, PropertyResponse, PropertySpec, ReadPropertyResponse,
            WritePropertyRequest, WritePropertyResponse, property_request::Payload as Request,
            property_response::Payload as Response,
        },
        tensor::{DoubleArray, Payload, StringArray, Uint32Array, Uint64Array},
        tensor_spec,
    },
};
use prost::Message;
use prost_types::Any;

const REQUEST: &str = "dm_env_rpc.v1.extensions.properties.PropertyRequest";
const RESPONSE_URL: &str = "type.googleapis.com/dm_env_rpc.v1.extensions.properties.PropertyResponse";

const PARAMETERS: &str = "parameters";
const APPLIED: &str = "applied";
const VERSION: &str = "version";
const SEED: &str = "seed";

/// A property with its present value.
struct Property {
    key: String,
    description: String,
    /// The value; `None` if the property only groups other properties.
    value: Option<Tensor>,
    /// The range of values that may be written, if it is limited.
    range: Option<(f64, f64)>,
    is_writable: bool,
}

/// Answers a request of a protocol extension. Only the extension for properties is supported.
///
/// # Errors
/// If the request belongs to another extension, cannot be decoded, or is refused.
pub(super) fn answer(catalogue: &Catalogue, joined: Option<&JoinedWorld>, request: &Any) -> Result<Any, Error> {
    let name = request.type_url.rsplit('/').next().unwrap_or_default();
    if name != REQUEST {
        return Err(Error::UnknownExtension { name: shorten(name), known: REQUEST });
    }
    let expected = "read_property, write_property or list_property";
    let request = PropertyRequest::decode(request.value.as_slice())
        .map_err(|error| Error::value("extension", format!("no {REQUEST}: {error}"), expected))?;
    let properties = properties(catalogue, joined);
    let response = match request.payload {
        Some(Request::ReadProperty(read)) => {
            let property = find(&properties, &read.key)?;
            let value = property.value.as_ref().ok_or_else(|| property.forbidden("read, only listed"))?;
            Response::ReadProperty(ReadPropertyResponse { value: Some(value.clone()) })
        }
        Some(Request::WriteProperty(write)) => {
            self::write(joined, find(&properties, &write.key)?, &write)?;
            Response::WriteProperty(WritePropertyResponse {})
        }
        Some(Request::ListProperty(list)) => {
            let values = self::list(&properties, &list.key)?.map(Property::spec).collect();
            Response::ListProperty(ListPropertyResponse { values })
        }
        None => return Err(Error::value("extension", "an empty PropertyRequest", expected)),
    };
    let value = PropertyResponse { payload: Some(response) }.encode_to_vec();
    Ok(Any { type_url: RESPONSE_URL.into(), value })
}

/// Returns all properties, in a fixed order: the properties of the server, then those of the joined world.
fn properties(catalogue: &Catalogue, joined: Option<&JoinedWorld>) -> Vec<Property> {
    let names: Vec<_> = catalogue.names().map(String::from).collect();
    let n = names.len();
    let mut all = vec![
        Property::new("server_version", "the server's version", text(env!("CARGO_PKG_VERSION"))),
        Property::new(
            "environments",
            "the values of env_id that create_world accepts",
            tensors::tensor(Payload::Strings(StringArray { array: names }), &[n]),
        ),
    ];
    // The pool reports starts of episodes only if a batch has receipts. Every world has receipts, so a joined world
    // always has a start.
    if let Some((joined, start)) = joined.and_then(|joined| Some((joined, joined.runner.start()?))) {
        all.extend(of_world(joined, start.id, start.receipt.as_ref()));
    }
    all
}

fn of_world(joined: &JoinedWorld, episode: EpisodeId, receipt: Option<&EpisodeReceipt>) -> Vec<Property> {
    let (spec, runner) = (joined.world.spec(), &joined.runner);
    let new = Property::new;
    let hash = receipt.map(|receipt| receipt.model_hash.clone()).unwrap_or_default();
    let mut all = vec![
        new("env_id", spec.description, text(spec.name)),
        new("revision", "raised by every change of the environment", uint32(spec.revision)),
        new("model_hash", "SHA-256 of the MJCF or of a task folder's files; empty without a model", text(hash)),
        new(VERSION, "D, R or E; a write sets the distributions of all parameters", text(runner.version().to_string()))
            .writable(),
        new(SEED, "fixes all randomness; writing it restarts the counts", uint64(runner.seed())).writable(),
        new("environment_index", "fixes randomness together with the seed", uint32(episode.environment_index)),
        new("trial_index", "counts trials from 0", uint64(episode.trial_index)),
        new("episode_index", "counts episodes from 0", uint64(episode.episode_index)),
        new("episodes_per_trial", "episodes with the same parameters", uint32(runner.episodes().episodes_per_trial)),
        new("step_limit", "the number of steps after which an episode is INTERRUPTED", uint32(spec.step_limit)),
        new("control_timestep", "simulated seconds in a step", double(spec.control_timestep)),
        Property::folder(PARAMETERS, "the values drawn or given for the episode; a write fixes a parameter"),
    ];
    let requested = receipt.map_or(&[][..], |receipt| &receipt.requested);
    for (parameter, value) in spec.parameters.iter().zip(requested) {
        let description = format!("{}, {}", parameter.description, parameter.unit);
        let mut property = new(&format!("{PARAMETERS}.{}", parameter.name), &description, double(*value));
        property.range = Some((parameter.bounds.low, parameter.bounds.high));
        all.push(property.writable());
    }
    all.push(Property::folder(APPLIED, "the values read back from the episode's physics"));
    let applied = receipt.map_or(&[][..], |receipt| &receipt.applied);
    for (quantity, value) in spec.applied.iter().zip(applied) {
        all.push(new(&format!("{APPLIED}.{}", quantity.name), quantity.unit, double(*value)));
    }
    all
}

fn find<'a>(properties: &'a [Property], key: &str) -> Result<&'a Property, Error> {
    properties.iter().find(|property| property.key == key).ok_or_else(|| Error::Unknown {
        what: "property",
        name: format!("{:?}", shorten(key)),
        known: "list the properties to see their names; most belong to a world and need a joined world".into(),
    })
}

/// Returns the properties that the property `key` groups. An empty `key` stands for the root.
fn list<'a>(properties: &'a [Property], key: &'a str) -> Result<impl Iterator<Item = &'a Property>, Error> {
    if !key.is_empty() {
        let property = find(properties, key)?;
        if property.value.is_some() {
            return Err(property.forbidden("listed"));
        }
    }
    Ok(properties.iter().filter(move |property| property.parent() == key))
}

fn write(joined: Option<&JoinedWorld>, property: &Property, request: &WritePropertyRequest) -> Result<(), Error> {
    // Only properties of the joined world are writable.
    let (Some(joined), true) = (joined, property.is_writable) else {
        return Err(property.forbidden("written"));
    };
    let field = format!("property {:?}", property.key);
    let no_value = || Error::value(field.clone(), "written without a value", "a tensor");
    let value = request.value.as_ref().ok_or_else(no_value)?;
    let mut change = WorldChange::default();
    match property.key.as_str() {
        VERSION => change.version = Some(settings::parse_version(field.clone(), tensors::text(&field, value)?)?),
        SEED => change.seed = Some(tensors::integer(&field, value, 0, u64::MAX)?),
        key => {
            let name = key.rsplit('.').next().unwrap_or_default();
            let parameter = joined.world.spec().parameters.iter().find(|parameter| parameter.name == name);
            let number = tensors::number(&field, value)?;
            change.parameters.extend(parameter.map(|parameter| (parameter.name, Distribution::fixed(number))));
        }
    }
    joined.world.change(change)
}

impl Property {
    fn new(key: &str, description: &str, value: Tensor) -> Self {
        Self { key: key.into(), description: description.into(), value: Some(value), range: None, is_writable: false }
    }

    fn folder(key: &str, description: &str) -> Self {
        Self { value: None, ..Self::new(key, description, Tensor::default()) }
    }

    fn writable(self) -> Self {
        Self { is_writable: true, ..self }
    }

    /// Returns the key of the property that groups this property; empty at the root.
    fn parent(&self) -> &str {
        self.key.rsplit_once('.').map_or("", |(parent, _)| parent)
    }

    fn spec(&self) -> PropertySpec {
        let bound = |x| tensor_spec::Value {
            payload: Some(tensor_spec::value::Payload::Doubles(DoubleArray { array: vec![x] })),
        };
        let value = self.value.as_ref();
        let dtype = value.and_then(tensors::dtype_and_count).map_or(DataType::InvalidDataType, |(dtype, _)| dtype);
        let spec = TensorSpec {
            name: self.key.clone(),
            shape: value.map(|value| value.shape.clone()).unwrap_or_default(),
            dtype: dtype.into(),
            min: self.range.map(|(low, _)| bound(low)),
            max: self.range.map(|(_, high)| bound(high)),
        };
        PropertySpec {
            spec: Some(spec),
            is_readable: self.value.is_some(),
            is_writable: self.is_writable,
            is_listable: self.value.is_none(),
            description: self.description.clone(),
        }
    }

    fn forbidden(&self, access: &'static str) -> Error {
        Error::Forbidden { key: self.key.clone(), access }
    }
}

fn text(text: impl Into<String>) -> Tensor {
    tensors::tensor(Payload::Strings(StringArray { array: vec![text.into()] }), &[])
}

fn uint32(n: u32) -> Tensor {
    tensors::tensor(Payload::Uint32s(Uint32Array { array: vec![n] }), &[])
}

fn uint64(n: u64) -> Tensor {
    tensors::tensor(Payload::Uint64s(Uint64Array { array: vec![n] }), &[])
}

fn double(x: f64) -> Tensor {
    tensors::tensor(Payload::Doubles(DoubleArray { array: vec![x] }), &[])
}
