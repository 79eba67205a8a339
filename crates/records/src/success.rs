//! Criteria for the success of an episode.

use std::fmt;
use std::str::FromStr;

use perturb_protocol::names::find;
use perturb_protocol::proto;
use serde::{Deserialize, Serialize};

use perturb_settings::{ValueError, require};

/// The names of quantities that are numbers of steps.
const STEPS: [&str; 2] = ["steps", "steps_in_a_row"];

/// A success criterion: an episode is a success if a quantity is on the right side of a threshold.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Criterion {
    /// The quantity that is compared, e.g. "steps" or "distance".
    pub quantity: String,
    /// The unit of the quantity; "1" for steps.
    pub unit: String,
    /// The side of the threshold on which values are successes.
    pub side: Side,
    /// The threshold, in the quantity's unit.
    pub threshold: f64,
    /// The maximum value that an episode can have: the step limit if the quantity is a number of steps, otherwise
    /// `None`. Thresholds above the maximum are rejected.
    #[serde(default)]
    pub most: Option<f64>,
}

/// A side of a threshold. Both sides include the threshold itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// Values at or above the threshold.
    AtLeast,
    /// Values at or below the threshold.
    AtMost,
}

/// A success threshold that the user chose, written for example `steps=90`.
#[derive(Clone, Debug, PartialEq)]
pub struct Threshold {
    /// The quantity that is compared.
    pub quantity: String,
    /// The threshold, in the quantity's unit.
    pub value: f64,
}

/// The rule that chooses the success criterion of a test, written `text`, `code` or for example `steps=90`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Rule {
    /// The environment's own criterion. In the paper's environments, this is the one that Packer et al. (2018) state in
    /// their paper.
    Text,
    /// The criterion that the published code of Packer et al. (2018) uses.
    Code,
    /// One of these two criteria with another threshold. The quantity in the threshold selects the criterion.
    At(Threshold),
}

/// The name of a threshold in error messages.
const THRESHOLD: &str = "the success threshold";

impl Criterion {
    /// Returns the own criterion of `environment`. In the paper's environments, this is the one that Packer et al.
    /// (2018) state in their paper. `None` if the server did not report it.
    pub fn from_environment(environment: &proto::Environment) -> Option<Self> {
        Self::read(environment.success.as_ref()?, environment.step_limit)
    }

    /// Returns the criterion that the published code of Packer et al. (2018) uses for `environment`. `None` if the
    /// server did not report it.
    pub fn from_environment_code(environment: &proto::Environment) -> Option<Self> {
        Self::read(environment.code_success.as_ref()?, environment.step_limit)
    }

    fn read(success: &proto::Success, step_limit: u32) -> Option<Self> {
        let side = match success.comparison() {
            proto::Comparison::Unspecified => return None,
            proto::Comparison::AtLeast => Side::AtLeast,
            proto::Comparison::AtMost => Side::AtMost,
        };
        let (quantity, unit) = (success.quantity.clone(), success.unit.clone());
        let most = STEPS.contains(&quantity.as_str()).then(|| f64::from(step_limit));
        Some(Self { quantity, unit, side, threshold: success.threshold, most })
    }

    /// Returns this criterion with another threshold.
    ///
    /// # Errors
    /// [`ValueError`] if the threshold is for another quantity, or above the step limit.
    pub fn with(&self, threshold: &Threshold) -> Result<Self, ValueError> {
        let expected = format!("a threshold for {}, e.g. {}={}", self.quantity, self.quantity, self.threshold);
        require(threshold.quantity == self.quantity, THRESHOLD, threshold, expected)?;
        let most = self.most.unwrap_or(f64::INFINITY);
        require(threshold.value <= most, THRESHOLD, threshold, format!("at most {most}, the step limit"))?;
        Ok(Self { threshold: threshold.value, ..self.clone() })
    }

    /// Returns whether an episode with this value is a success. An episode without a value is a failure.
    pub fn holds(&self, achieved: Option<f64>) -> bool {
        achieved.is_some_and(|achieved| match self.side {
            Side::AtLeast => achieved >= self.threshold,
            Side::AtMost => achieved <= self.threshold,
        })
    }
}

impl Rule {
    /// Returns the criterion that this rule chooses. `text` and `code` are the environment's two criteria.
    ///
    /// # Errors
    /// [`ValueError`] if the server did not state the criterion. For a threshold, also if neither criterion compares
    /// the threshold's quantity, or if the threshold is above the step limit.
    pub fn criterion(&self, text: Option<&Criterion>, code: Option<&Criterion>) -> Result<Criterion, ValueError> {
        let unknown = |missing: &'static str| {
            let expected = format!("left out: the server does not report {missing}");
            move || ValueError::new("the rule of success", self, expected)
        };
        match self {
            Self::Code => code.cloned().ok_or_else(unknown("the success rule of the paper's code")),
            Self::Text | Self::At(_) => {
                let text = text.ok_or_else(unknown("the quantity of its success rule"))?;
                let Self::At(threshold) = self else { return Ok(text.clone()) };
                let other = code.filter(|code| code.quantity == threshold.quantity && text.quantity != code.quantity);
                other.unwrap_or(text).with(threshold)
            }
        }
    }
}

impl fmt::Display for Criterion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let side = match self.side {
            Side::AtLeast => "at least",
            Side::AtMost => "at most",
        };
        let unit = if self.unit == "1" { String::new() } else { format!(" {}", self.unit) };
        write!(f, "{} {side} {}{unit}", self.quantity, self.threshold)
    }
}

impl fmt::Display for Threshold {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.quantity, self.value)
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Text => f.write_str("text"),
            Self::Code => f.write_str("code"),
            Self::At(threshold) => threshold.fmt(f),
        }
    }
}

impl FromStr for Rule {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        match find(text.trim(), ["text", "code"].into_iter()) {
            Some(0) => Ok(Self::Text),
            Some(_) => Ok(Self::Code),
            None => text.parse().map(Self::At),
        }
    }
}

impl TryFrom<String> for Rule {
    type Error = ValueError;

    fn try_from(text: String) -> Result<Self, ValueError> {
        text.parse()
    }
}

impl From<Rule> for String {
    fn from(rule: Rule) -> Self {
        rule.to_string()
    }
}

impl FromStr for Threshold {
    type Err = ValueError;

    fn from_str(text: &str) -> Result<Self, ValueError> {
        let text = text.trim();
        let wrong = || ValueError::new(THRESHOLD, format!("`{text}`"), "text, code, or QUANTITY=NUMBER, e.g. steps=90");
        let (quantity, value) = text.split_once('=').ok_or_else(wrong)?;
        let value = value.trim().parse::<f64>().ok().filter(|value| value.is_finite()).ok_or_else(wrong)?;
        Ok(Self { quantity: quantity.trim().to_owned(), value })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(side: Side, threshold: f64) -> Criterion {
        Criterion { quantity: "steps".into(), unit: "1".into(), side, threshold, most: Some(500.0) }
    }

    #[test]
    fn a_threshold_belongs_to_its_side() {
        let (most, least) = (steps(Side::AtMost, 80.0), steps(Side::AtLeast, 80.0));
        for (achieved, at_most, at_least) in
            [(Some(79.0), true, false), (Some(80.0), true, true), (Some(81.0), false, true), (None, false, false)]
        {
            assert_eq!((most.holds(achieved), least.holds(achieved)), (at_most, at_least), "{achieved:?}");
        }
        assert_eq!(most.to_string(), "steps at most 80");
    }

    #[test]
    fn rule_is_text_code_or_a_threshold() {
        let text = steps(Side::AtLeast, 100.0);
        let code = Criterion { quantity: "steps_in_a_row".into(), threshold: 90.0, ..text.clone() };
        let of = |rule: &str| rule.parse::<Rule>().unwrap().criterion(Some(&text), Some(&code)).unwrap();
        assert_eq!((of("text"), of("code")), (text.clone(), code.clone()));
        assert_eq!(of("steps=80"), Criterion { threshold: 80.0, ..text.clone() });
        assert_eq!(of("steps_in_a_row=70"), Criterion { threshold: 70.0, ..code.clone() });
        let refused = |rule: &str| rule.parse::<Rule>().unwrap().criterion(Some(&text), None).unwrap_err().to_string();
        assert_eq!(
            refused("code"),
            "the rule of success is code, but must be left out: the server does not report the success rule of the \
             paper's code"
        );
        assert!(
            refused("steps_in_a_row=70").contains("must be a threshold for steps"),
            "no criterion compares this quantity"
        );
        for rule in ["text", "code", "steps=90"] {
            assert_eq!(rule.parse::<Rule>().unwrap().to_string(), rule);
        }
        assert_eq!(" Code".parse::<Rule>().unwrap(), Rule::Code, "case and spaces do not matter");
    }

    #[test]
    fn another_threshold_must_be_of_the_same_quantity() {
        let criterion = steps(Side::AtMost, 80.0);
        assert_eq!(criterion.with(&"steps=90".parse().unwrap()).unwrap().threshold, 90.0);
        let error = criterion.with(&"distance=90".parse().unwrap()).unwrap_err().to_string();
        assert_eq!(error, "the success threshold is distance=90, but must be a threshold for steps, e.g. steps=80");
        let error = criterion.with(&"steps=501".parse().unwrap()).unwrap_err().to_string();
        assert_eq!(error, "the success threshold is steps=501, but must be at most 500, the step limit");
        for text in ["90", "steps=", "steps=x", "steps=nan"] {
            assert!(text.parse::<Threshold>().unwrap_err().to_string().contains("QUANTITY=NUMBER"), "{text}");
        }
    }
}
