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
    escape(&mut catalogue.server_version);
    catalogue.environments.iter_mut().for_each(escape_environment);
}

/// Escapes all texts in the description of an environment.
pub fn escape_environment(environment: &mut Environment) {
    let Environment {
        name,
        description,
        parameters,
        observation,
        state,
        reward_terms,
        applied,
        model_hash,
        heatmap_axes,
        action,
        success,
        code_success,
        ..
    } = environment;
    let parameters =
        parameters.iter_mut().flat_map(|it| [&mut it.name, &mut it.unit, &mut it.description, &mut it.applied]);
    let terms = reward_terms.iter_mut().flat_map(|it| [&mut it.name, &mut it.description]);
    let quantities = applied.iter_mut().flat_map(|it| [&mut it.name, &mut it.unit]);
    let rules = success.iter_mut().chain(code_success);
    let rules = rules.flat_map(|it| [&mut it.description, &mut it.quantity, &mut it.unit]);
    let texts = [name, description, model_hash].into_iter().chain(heatmap_axes);
    texts.chain(parameters).chain(terms).chain(quantities).chain(rules).for_each(escape);
    escape_channels(observation);
    escape_channels(state);
    match action.as_mut().and_then(|action| action.kind.as_mut()) {
        Some(Kind::Discrete(discrete)) => discrete.names.iter_mut().for_each(escape),
        Some(Kind::Continuous(continuous)) => escape_channels(&mut continuous.channels),
        None => {}
    }
}

fn escape_channels(channels: &mut [Channel]) {
    channels.iter_mut().flat_map(|it| [&mut it.name, &mut it.unit]).for_each(escape);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proto::{Parameter, Success};

    const HOSTILE: &str = "a\u{1b}]0;title\u{7}\u{1b}[2Jb\u{9b}31m\u{202e}\r\n\tc";

    #[test]
    fn lines_stay_lines() {
        assert_eq!(escape_lines("one\u{1b}[2J\ntwo\r"), "one\\u{1b}[2J\ntwo\\r");
    }

    #[test]
    fn every_text_of_a_catalogue_is_escaped() {
        let hostile = || HOSTILE.to_owned();
        let channel = || Channel { name: hostile(), unit: hostile(), ..Channel::default() };
        let parameter = Parameter {
            name: hostile(),
            unit: hostile(),
            description: hostile(),
            applied: hostile(),
            ..Parameter::default()
        };
        let success = || Success { description: hostile(), quantity: hostile(), unit: hostile(), ..Success::default() };
        let environment = Environment {
            name: hostile(),
            description: hostile(),
            parameters: vec![parameter],
            observation: vec![channel()],
            state: vec![channel()],
            heatmap_axes: vec![hostile()],
            success: Some(success()),
            code_success: Some(success()),
            ..Environment::default()
        };
        let mut catalogue = ListEnvironmentsResponse {
            environments: vec![environment],
            server_version: hostile(),
            ..Default::default()
        };
        escape_catalogue(&mut catalogue);
        let shown = format!("{catalogue:?}");
        assert!(!shown.replace("\\\\u", "").contains("\\u{"), "{shown}");
    }
}
