//! Escapes untrusted text before it is written to a terminal or a log.

use std::borrow::Cow;

/// Escapes all control characters in a text, including newlines and tabs, and characters that change the direction of
/// text. A terminal would interpret such characters: they can colour, move, delete and paste text. In a log, a newline
/// could forge an entry.
pub fn escape_terminal(text: &str) -> Cow<'_, str> {
    if !text.chars().any(is_interpreted) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        match is_interpreted(character) {
            true => shown.extend(character.escape_default()),
            false => shown.push(character),
        }
    }
    Cow::Owned(shown)
}

/// Whether terminals or text viewers interpret a character instead of showing it.
fn is_interpreted(character: char) -> bool {
    character.is_control()
        || matches!(character, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[rstest::rstest]
    #[case::plain("CartPole: 97 % ± 2, “größer”", "CartPole: 97 % ± 2, “größer”")]
    #[case::colour("\u{1b}[31mred", "\\u{1b}[31mred")]
    #[case::title("\u{1b}]0;title\u{7}", "\\u{1b}]0;title\\u{7}")]
    #[case::c1_sequence("\u{9b}2J", "\\u{9b}2J")]
    #[case::lines("one\r\ntwo\t\u{8}", "one\\r\\ntwo\\t\\u{8}")]
    #[case::reordered("a\u{202e}b\u{2066}c", "a\\u{202e}b\\u{2066}c")]
    fn control_characters_are_escaped(#[case] text: &str, #[case] shown: &str) {
        assert_eq!(escape_terminal(text), shown);
    }

    #[test]
    fn harmless_text_is_not_copied() {
        assert!(matches!(escape_terminal("a server's words"), Cow::Borrowed(_)));
    }
}
