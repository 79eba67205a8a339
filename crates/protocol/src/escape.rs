//! Escapes texts from servers, since a hostile server could send control sequences to the user's terminal.

use perturb_system::escape_terminal;

use crate::proto::action_space::Kind;
use crate::proto::{Channel, Environment, ListEnvironmentsResponse};

/// Escapes the control characters in each line of a text, see [`escape_terminal`]. Line breaks stay.
pub fn escape_lines(text: &str) -> String {
    text.split('\n').map(escape_terminal).collect::<Vec<_>>().join("\n")
}

/// Escapes a text in place.
fn escape(text: &mut String) {
    *text = escape_lines(text);
}

/// Escapes all texts in a catalogue of environments.
pub(crate) fn escape_catalogue(catalogue: &mut ListEnvironmentsResponse) {
    let ListEnvironmentsResponse { environments, server_version, features, max_batch_size: _ } = catalogue;
    escape(server_version);
    features.iter_mut().for_each(escape);
    environments.iter_mut().for_each(escape_environment);
}

/// Escapes all texts in the description of an environment.
pub fn escape_environment(environment: &mut Environment) {
    // The pattern names every field, so that a new field is not forgotten.
    let Environment {
        name,
        revision: _,
        description,
        parameters,
        observation,
        action,
        state,
        reward_terms,
        applied,
        step_limit: _,
        control_timestep: _,
        success,
        model_hash,
        heatmap_axes,
        code_success,
        parameter_observations,
        disturbances,
    } = environment;
    let parameters = parameters.iter_mut().chain(disturbances);
    let parameters = parameters.flat_map(|it| [&mut it.name, &mut it.unit, &mut it.description, &mut it.applied]);
    let terms = reward_terms.iter_mut().flat_map(|it| [&mut it.name, &mut it.description]);
    let quantities = applied.iter_mut().flat_map(|it| [&mut it.name, &mut it.unit]);
    let rules = success.iter_mut().chain(code_success);
    let rules = rules.flat_map(|it| [&mut it.description, &mut it.quantity, &mut it.unit]);
    let texts = [name, description, model_hash].into_iter().chain(heatmap_axes);
    texts.chain(parameters).chain(terms).chain(quantities).chain(rules).for_each(escape);
    let observed = parameter_observations.iter_mut().filter_map(|it| it.entry.as_mut());
    observation.iter_mut().chain(state).chain(observed).for_each(escape_channel);
    match action.as_mut().and_then(|action| action.kind.as_mut()) {
        Some(Kind::Discrete(discrete)) => discrete.names.iter_mut().for_each(escape),
        Some(Kind::Continuous(continuous)) => continuous.channels.iter_mut().for_each(escape_channel),
        None => {}
    }
}

fn escape_channel(channel: &mut Channel) {
    [&mut channel.name, &mut channel.unit].into_iter().for_each(escape);
}

#[cfg(test)]
mod tests {
    use prost::Message as _;
    use prost::encoding::{encode_varint, string};
    use prost_types::field_descriptor_proto::Type;
    use prost_types::{DescriptorProto, FileDescriptorSet};

    use super::*;
    use crate::proto::DESCRIPTORS;

    const HOSTILE: &str = "a\u{1b}]0;title\u{7}\u{1b}[2Jb\u{9b}31m\u{202e}\r\n\tc";

    #[test]
    fn lines_stay_lines() {
        assert_eq!(escape_lines("one\u{1b}[2J\ntwo\r"), "one\\u{1b}[2J\ntwo\\r");
    }

    /// Encodes a message in which every text is [`HOSTILE`] and every list has one entry. The kind of actions is
    /// `action`.
    fn hostile(messages: &[DescriptorProto], message: &str, action: &str) -> Vec<u8> {
        let message = messages.iter().find(|other| message.ends_with(&format!(".{}", other.name()))).unwrap();
        let mut bytes = Vec::new();
        for field in message.field.iter().filter(|field| field.oneof_index.is_none() || field.name() == action) {
            let number = field.number().unsigned_abs();
            match field.r#type() {
                Type::String => string::encode(number, &HOSTILE.to_owned(), &mut bytes),
                Type::Message => {
                    let inner = hostile(messages, field.type_name(), action);
                    encode_varint(u64::from(number << 3 | 2), &mut bytes);
                    encode_varint(inner.len() as u64, &mut bytes);
                    bytes.extend(inner);
                }
                _ => {}
            }
        }
        bytes
    }

    #[test]
    fn every_text_of_a_catalogue_is_escaped() {
        let files = FileDescriptorSet::decode(DESCRIPTORS).unwrap().file;
        let contract = files.iter().find(|file| file.package() == "perturb.v1").unwrap();
        let unescaped = |shown: String| shown.replace("\\\\u", "").matches("\\u{1b}").count();
        for action in ["discrete", "continuous"] {
            let bytes = hostile(&contract.message_type, ".ListEnvironmentsResponse", action);
            let mut catalogue = ListEnvironmentsResponse::decode(&*bytes).unwrap();
            assert!(unescaped(format!("{catalogue:?}")) > 40, "{catalogue:?}");
            escape_catalogue(&mut catalogue);
            assert_eq!(unescaped(format!("{catalogue:?}")), 0, "{catalogue:?}");
        }
    }
}
