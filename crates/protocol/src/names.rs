//! Compares names as users write them. Case, `-` and `_` are ignored, and an environment may also be given by its
//! Gymnasium id. Unknown names are refused with a suggestion of the most similar name.

/// Minimal Jaro-Winkler similarity of a suggested name, from 0 (unlike) to 1 (equal). Names of lower similarity mostly
/// resemble each other by chance.
const MIN_SIMILARITY: f64 = 0.8;
/// The namespace at the start of the environments' Gymnasium ids.
const NAMESPACE: &str = "perturb/";

/// Whether `written` is a spelling of the name `known`, such as `cart-pole` of `CartPole` or `r+e` of `R+E`.
pub fn is_spelled(written: &str, known: &str) -> bool {
    letters(written).eq(letters(known))
}

fn letters(name: &str) -> impl Iterator<Item = char> {
    name.chars().filter(|c| !matches!(c, '-' | '_')).map(|c| c.to_ascii_lowercase())
}

/// Returns the index of the name in `known` that `written` means: an exact match, otherwise the first name that differs
/// only in case, `-` and `_`.
pub fn find<'a>(written: &str, known: impl Iterator<Item = &'a str> + Clone) -> Option<usize> {
    known.clone().position(|name| name == written).or_else(|| known.clone().position(|name| is_spelled(written, name)))
}

/// Returns the name in `known` that is most similar to `written`; `None` if no name is similar enough to be suggested.
pub fn closest<'a>(written: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let written: String = letters(written).collect();
    let alike = |name: &str| strsim::jaro_winkler(&written, &letters(name).collect::<String>());
    let (best, name) = known.map(|name| (alike(name), name)).max_by(|(a, _), (b, _)| a.total_cmp(b))?;
    (best >= MIN_SIMILARITY).then_some(name)
}

/// Returns a suggestion for the end of an error message, such as " (did you mean `CartPole`?)". Empty if no name is
/// similar enough.
pub fn did_you_mean<'a>(written: &str, known: impl Iterator<Item = &'a str>) -> String {
    closest(written, known).map_or_else(String::new, |name| format!(" (did you mean `{name}`?)"))
}

/// An environment as a user writes it: by its catalogue name, or by its Gymnasium id, such as `perturb/CartPole-v1`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EnvironmentName {
    /// The name, without the namespace and revision of an id. Its spelling may differ from the catalogue's.
    pub name: String,
    /// The revision at the end of an id, such as 1 in `perturb/CartPole-v1`.
    pub revision: Option<u32>,
}

/// The error for a name or id that means no environment of the catalogue.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum UnknownEnvironment {
    /// No environment has the name.
    #[error("there is no environment {name:?}{hint}; there are {known}")]
    Name {
        /// The name as the user wrote it.
        name: String,
        /// The suggestion of [`did_you_mean`], possibly empty.
        hint: String,
        /// The names of all environments, separated by commas.
        known: String,
    },
    /// The server's environment has another revision than the id.
    #[error(
        "`perturb/{name}-v{asked}` is another revision than the server's `perturb/{name}-v{served}`: write \
         `perturb/{name}-v{served}` or `{name}`, or run a server that has revision {asked}"
    )]
    Revision {
        /// The environment's name.
        name: String,
        /// The revision in the id.
        asked: u32,
        /// The revision that the server has.
        served: u32,
    },
}

impl EnvironmentName {
    /// Splits a Gymnasium id into name and revision. Any other text is taken as a name.
    pub fn new(written: &str) -> Self {
        let plain = |name: &str| Self { name: name.to_owned(), revision: None };
        let id = written.get(..NAMESPACE.len()).filter(|start| start.eq_ignore_ascii_case(NAMESPACE));
        let Some(rest) = id.map(|_| &written[NAMESPACE.len()..]) else { return plain(written) };
        match rest.rsplit_once("-v").map(|(name, revision)| (name, revision.parse())) {
            Some((name, Ok(revision))) => Self { name: name.to_owned(), revision: Some(revision) },
            _ => plain(rest),
        }
    }

    /// Returns the index of the environment in `known`, which lists the name and revision of each environment.
    ///
    /// # Errors
    /// [`UnknownEnvironment`] if no environment has the name, or if the environment has another revision than the id.
    pub fn find<'a>(&self, known: impl Iterator<Item = (&'a str, u32)> + Clone) -> Result<usize, UnknownEnvironment> {
        let names = known.clone().map(|(name, _)| name);
        let Some(place) = find(&self.name, names.clone()) else {
            let hint = did_you_mean(&self.name, names.clone());
            let known = names.collect::<Vec<_>>().join(", ");
            return Err(UnknownEnvironment::Name { name: self.name.clone(), hint, known });
        };
        match known.clone().nth(place).zip(self.revision) {
            Some(((name, served), asked)) if asked != served => {
                Err(UnknownEnvironment::Revision { name: name.to_owned(), asked, served })
            }
            _ => Ok(place),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KNOWN: [(&str, u32); 3] = [("CartPole", 1), ("MountainCar", 0), ("HalfCheetah", 2)];

    fn found(written: &str) -> Result<usize, String> {
        EnvironmentName::new(written).find(KNOWN.into_iter()).map_err(|error| error.to_string())
    }

    #[test]
    fn environment_is_found_in_all_spellings() {
        for written in
            ["CartPole", "cartpole", "Cartpole", "cart_pole", "cart-pole", "perturb/CartPole-v1", "Perturb/cartpole"]
        {
            assert_eq!(found(written), Ok(0), "{written}");
        }
        assert_eq!(found("perturb/half-cheetah-v2"), Ok(2));
    }

    #[test]
    fn unknown_name_is_refused_with_a_hint() {
        let refused = |written| found(written).unwrap_err();
        assert_eq!(
            refused("CartPool"),
            "there is no environment \"CartPool\" (did you mean `CartPole`?); there are CartPole, MountainCar, HalfCheetah"
        );
        assert_eq!(refused("Pong"), "there is no environment \"Pong\"; there are CartPole, MountainCar, HalfCheetah");
        assert!(refused("perturb/CartPole-v0").starts_with("`perturb/CartPole-v0` is another revision"));
        // An id without the namespace `perturb/` is that of Gymnasium's own environment.
        assert!(refused("CartPole-v1").contains("(did you mean `CartPole`?)"));
        assert!(refused("perturb/").starts_with("there is no environment \"\";"));
        assert!(refused("pértürb/CartPole").starts_with("there is no environment \"pértürb/CartPole\""));
    }

    #[test]
    fn exact_spelling_wins() {
        let known = ["cart_pole", "CartPole"];
        assert_eq!(find("CartPole", known.into_iter()), Some(1));
        assert_eq!(find("CARTPOLE", known.into_iter()), Some(0));
    }

    #[test]
    fn hint_needs_similarity() {
        let keys = ["learning_rate", "n_steps", "num_envs"];
        assert_eq!(closest("learning-rat", keys.into_iter()), Some("learning_rate"));
        assert_eq!(closest("nsteps", keys.into_iter()), Some("n_steps"));
        assert_eq!(closest("foo", keys.into_iter()), None);
    }
}
