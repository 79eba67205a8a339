//! Formatting of numbers, durations and long texts for people, and of words for shells.

use std::ffi::OsStr;

/// Formats a number with its digits in groups of three, e.g. "1 200".
pub fn grouped(number: usize) -> String {
    let digits = number.to_string();
    let mut text = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// Formats a number with a noun, with the digits in groups of three: "1 cell", "1 200 cells".
pub fn counted(number: usize, what: &str) -> String {
    format!("{} {what}{}", grouped(number), if number == 1 { "" } else { "s" })
}

/// Formats a number with a noun, without groups of digits: "1 cell", "1200 cells".
pub fn count(number: usize, noun: &str) -> String {
    if number == 1 { format!("1 {noun}") } else { format!("{number} {noun}s") }
}

/// Formats a duration in its two largest units, e.g. "2 h 5 min".
pub fn duration(seconds: f64) -> String {
    let seconds = seconds.round() as u64;
    let (minutes, hours, days) = (seconds / 60, seconds / 3600, seconds / 86_400);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, _) => format!("{minutes} min {} s", seconds % 60),
        (0, _, _) => format!("{hours} h {} min", minutes % 60),
        (0..1000, _, _) => format!("{days} d {} h", hours % 24),
        _ => format!("{} years", grouped((days as f64 / 365.25).round() as usize)),
    }
}

/// Quotes a text, e.g. a path, so that a shell takes it as one word.
pub fn quoted(word: impl AsRef<OsStr>) -> String {
    let word = word.as_ref().to_string_lossy();
    shlex::try_quote(&word).map_or_else(|_| word.to_string(), |quoted| quoted.into_owned())
}

/// The length to which [`shortened`] cuts texts, in characters.
const MAX_CHARS: usize = 300;

/// Cuts a text after 300 characters. A cut is marked by ` …`.
pub fn shortened(text: impl Into<String>) -> String {
    let mut text = text.into();
    if let Some((end, _)) = text.char_indices().nth(MAX_CHARS) {
        text.truncate(end);
        text.push_str(" …");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_stand_in_groups_of_three() {
        let shown = [0, 12, 183, 3294, 9882, 49_410, 1_234_567].map(grouped);
        assert_eq!(shown, ["0", "12", "183", "3 294", "9 882", "49 410", "1 234 567"]);
    }

    #[test]
    fn one_thing_is_no_plural() {
        let shown = [0, 1, 2, 1200].map(|number| counted(number, "cell"));
        assert_eq!(shown, ["0 cells", "1 cell", "2 cells", "1 200 cells"]);
    }

    #[test]
    fn of_a_long_text_the_beginning_is_shown() {
        let [short, long] = [300, 301].map(|length| "ü".repeat(length));
        assert_eq!(shortened(&*short), short);
        assert_eq!(shortened(long), short + " …");
    }

    #[test]
    fn times_have_two_units() {
        let shown = [0.4, 59.4, 61.0, 3600.0, 90_000.0, 86_400.0 * 400.0, 86_400.0 * 3652.5].map(duration);
        assert_eq!(shown, ["0 s", "59 s", "1 min 1 s", "1 h 0 min", "1 d 1 h", "400 d 0 h", "10 years"]);
    }
}
