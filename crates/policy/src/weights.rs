//! Arrays with names, in which weights and optimiser states are saved.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// An array with a name, in row-major order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NamedArray {
    /// The name, which is unique in its list.
    pub name: String,
    /// The length of each axis.
    pub shape: Vec<usize>,
    /// The elements. Their number is the product of `shape`.
    pub data: Vec<f32>,
}

/// The weights of a policy, in the order of [`PolicySpec::layout`](crate::PolicySpec::layout).
pub type Weights = Vec<NamedArray>;

/// Checks that `arrays` have the names, shapes and lengths of `layout`, in order.
///
/// # Errors
/// [`Error::Arrays`] at the first difference.
pub fn check_arrays(arrays: &[NamedArray], layout: &[(String, Vec<usize>)]) -> Result<()> {
    let say = |name: &str, shape: &[usize], length: usize| format!("\"{name}\" {shape:?} of {length} elements");
    for position in 0..arrays.len().max(layout.len()) {
        let got = arrays.get(position).map(|array| say(&array.name, &array.shape, array.data.len()));
        let expected = layout.get(position).map(|(name, shape)| say(name, shape, shape.iter().product()));
        if got != expected {
            let got = got.unwrap_or_else(|| "missing".to_owned());
            let expected = expected.unwrap_or_else(|| "nothing".to_owned());
            return Err(Error::Arrays { position, got, expected });
        }
    }
    Ok(())
}
