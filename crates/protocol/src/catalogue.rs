//! The catalogue of environments, also as JSON for programs that do not speak the protocol.

use std::borrow::Cow;

use serde_json::{Value, json};

use crate::limits;
use crate::proto::{
    Channel, Comparison, Distribution, Environment, ListEnvironmentsResponse, Parameter, ParameterObservation,
    Quantity, Success, action_space::Kind,
};

/// Converts the catalogue of a server to JSON, together with the [`limits`] that clients must keep. Keys are the
/// protocol's field names; versions are called D, R and E. An infinite bound becomes `null`, because JSON has no
/// infinity.
pub fn to_json(catalogue: &ListEnvironmentsResponse) -> Value {
    json!({
        "server_version": catalogue.server_version,
        "max_batch_size": catalogue.max_batch_size,
        "environments": catalogue.environments.iter().map(environment).collect::<Vec<_>>(),
        "limits": {
            "picture_pixels": [limits::PICTURE_PIXELS.start(), limits::PICTURE_PIXELS.end()],
            "default_picture_pixels": limits::DEFAULT_PICTURE_PIXELS,
            "max_intervals": limits::MAX_INTERVALS,
            "max_socket_path_bytes": limits::MAX_SOCKET_PATH_BYTES,
            // The keys of version 0.1 for the values above.
            "usual_picture_pixels": limits::DEFAULT_PICTURE_PIXELS,
            "most_intervals": limits::MAX_INTERVALS,
            "longest_socket_path": limits::MAX_SOCKET_PATH_BYTES,
            "default_port": limits::DEFAULT_PORT,
            "default_max_envs": limits::DEFAULT_MAX_ENVS,
            "default_max_message_bytes": limits::DEFAULT_MAX_MESSAGE_BYTES,
        },
    })
}

impl Environment {
    /// Returns the parameter or disturbance with this name.
    pub fn parameter(&self, name: &str) -> Option<&Parameter> {
        self.parameters.iter().chain(&self.disturbances).find(|parameter| parameter.name == name)
    }

    /// Returns this environment as it is in a session that was opened with values for the parameters `names`. If one of
    /// the names is a disturbance, [all disturbances](Self::disturbed) are appended to the environment's parameters.
    pub fn with_parameters<'a>(&self, names: impl IntoIterator<Item = &'a str>) -> Cow<'_, Self> {
        let is_own = |name: &str| self.parameters.iter().any(|parameter| parameter.name == name);
        let is_disturbance = |name: &str| self.disturbances.iter().any(|disturbance| disturbance.name == name);
        let names_one = names.into_iter().any(|name| !is_own(name) && is_disturbance(name));
        if names_one { Cow::Owned(self.disturbed()) } else { Cow::Borrowed(self) }
    }

    /// Returns this environment with all disturbances appended to its parameters. Sessions whose requests name a
    /// disturbance use this form.
    #[must_use]
    pub fn disturbed(&self) -> Self {
        let mut disturbed = self.clone();
        for disturbance in &self.disturbances {
            let Parameter { name, unit, .. } = disturbance;
            if self.parameters.iter().any(|parameter| parameter.name == *name) {
                continue;
            }
            disturbed.parameters.push(disturbance.clone());
            disturbed.applied.push(Quantity { name: name.clone(), unit: unit.clone() });
            disturbed.parameter_observations.push(observation(disturbance));
        }
        disturbed
    }

    /// Returns this environment as it is in a session. If `parameters` is true, the values of the parameters are
    /// appended to its observations.
    #[must_use]
    pub fn observed(&self, parameters: bool) -> Self {
        let mut session = self.clone();
        if parameters {
            session.observation.extend(self.parameter_observations.iter().filter_map(|seen| seen.entry.clone()));
        }
        session
    }
}

/// Returns how an observation scales a disturbance: its minimum in the sets of versions R and E becomes -1, its maximum
/// becomes 1.
fn observation(disturbance: &Parameter) -> ParameterObservation {
    let sets = [&disturbance.random, &disturbance.extreme].into_iter().flatten();
    let intervals = sets.flat_map(|set| &set.intervals).map(|interval| (interval.low, interval.high));
    let default = (disturbance.default_value, disturbance.default_value);
    let widest = |a: (f64, f64), b: (f64, f64)| (a.0.min(b.0), a.1.max(b.1));
    let (low, high) = intervals.reduce(widest).unwrap_or(default);
    let observed = |value: f64| {
        let distance = value - low;
        f64::from((if high > low { 2.0 * distance / (high - low) - 1.0 } else { distance }) as f32)
    };
    let entry = Channel {
        name: format!("parameter_{}", disturbance.name),
        unit: "1".into(),
        low: observed(disturbance.low),
        high: observed(disturbance.high),
    };
    ParameterObservation { entry: Some(entry), at_minus_one: low, at_plus_one: high }
}

/// Converts an environment to JSON, see [`to_json`].
pub fn environment(environment: &Environment) -> Value {
    let action = match environment.action.as_ref().and_then(|action| action.kind.as_ref()) {
        Some(Kind::Discrete(discrete)) => json!({ "discrete": discrete.names }),
        Some(Kind::Continuous(continuous)) => json!({ "continuous": continuous.channels }),
        None => Value::Null,
    };
    json!({
        "name": environment.name,
        "revision": environment.revision,
        "description": environment.description,
        "step_limit": environment.step_limit,
        "control_timestep": environment.control_timestep,
        "observation": environment.observation,
        "parameter_observations": environment.parameter_observations.iter().map(seen).collect::<Vec<_>>(),
        "action": action,
        "state": environment.state,
        "reward_terms": environment.reward_terms,
        "success": environment.success.as_ref().map(success),
        "parameters": environment.parameters.iter().map(parameter).collect::<Vec<_>>(),
        "disturbances": environment.disturbances.iter().map(parameter).collect::<Vec<_>>(),
        "applied": environment.applied,
        "heatmap_axes": environment.heatmap_axes,
        "model_hash": environment.model_hash,
    })
}

fn seen(seen: &ParameterObservation) -> Value {
    json!({ "entry": seen.entry, "at_minus_one": seen.at_minus_one, "at_plus_one": seen.at_plus_one })
}

fn parameter(parameter: &Parameter) -> Value {
    let intervals = |distribution: Option<&Distribution>| {
        let intervals = distribution.map(|distribution| distribution.intervals.as_slice()).unwrap_or_default();
        intervals.iter().map(|interval| json!([interval.low, interval.high])).collect::<Vec<_>>()
    };
    json!({
        "name": parameter.name,
        "unit": parameter.unit,
        "description": parameter.description,
        "low": parameter.low,
        "high": parameter.high,
        "D": parameter.default_value,
        "R": intervals(parameter.random.as_ref()),
        "E": intervals(parameter.extreme.as_ref()),
        "applied": parameter.applied,
        "integer": parameter.integer,
    })
}

fn success(success: &Success) -> Value {
    let comparison = match success.comparison() {
        Comparison::AtLeast => json!("at_least"),
        Comparison::AtMost => json!("at_most"),
        Comparison::Unspecified => Value::Null,
    };
    json!({
        "description": success.description,
        "quantity": success.quantity,
        "unit": success.unit,
        "comparison": comparison,
        "threshold": success.threshold,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn open_end_is_null() {
        let open = Channel { name: "x".into(), unit: "m".into(), low: f64::NEG_INFINITY, high: 1.5 };
        let json = to_json(&ListEnvironmentsResponse {
            environments: vec![Environment { observation: vec![open], ..Environment::default() }],
            ..ListEnvironmentsResponse::default()
        });
        let expected = json!([{ "name": "x", "unit": "m", "low": null, "high": 1.5 }]);
        assert_eq!(json["environments"][0]["observation"], expected);
    }
}
