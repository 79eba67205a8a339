//! Checks the type, shape, number of elements and bounds of tensors. A tensor of an unexpected type is refused, not
//! converted; only integer scalars may have any of four types.

use super::Error;
use crate::proto::dm_env_rpc::v1::{DataType, Tensor, tensor::Payload};
use std::fmt::Display;

/// The maximum number of dimensions of a shape that an error message shows.
const MAX_SHOWN_DIMENSIONS: usize = 8;

/// Returns the text of a STRING scalar.
///
/// # Errors
/// If `tensor` is not a STRING scalar.
pub(super) fn text<'a>(field: &str, tensor: &'a Tensor) -> Result<&'a str, Error> {
    match (&tensor.payload, tensor.shape.as_slice()) {
        (Some(Payload::Strings(strings)), []) if strings.array.len() == 1 => Ok(&strings.array[0]),
        _ => Err(refuse(field, tensor, "a scalar: STRING, shape [], elements: 1")),
    }
}

/// Returns the value of a BOOL scalar.
///
/// # Errors
/// If `tensor` is not a BOOL scalar.
pub(super) fn boolean(field: &str, tensor: &Tensor) -> Result<bool, Error> {
    match (&tensor.payload, tensor.shape.as_slice()) {
        (Some(Payload::Bools(bools)), []) if bools.array.len() == 1 => Ok(bools.array[0]),
        _ => Err(refuse(field, tensor, "a scalar: BOOL, shape [], elements: 1")),
    }
}

/// Returns the value of a DOUBLE scalar.
///
/// # Errors
/// If `tensor` is not a DOUBLE scalar, or not finite.
pub(super) fn number(field: &str, tensor: &Tensor) -> Result<f64, Error> {
    match (&tensor.payload, tensor.shape.as_slice()) {
        (Some(Payload::Doubles(doubles)), []) if doubles.array.len() == 1 => match doubles.array[0] {
            x if x.is_finite() => Ok(x),
            x => Err(Error::value(field.to_owned(), x, "a finite number")),
        },
        _ => Err(refuse(field, tensor, "a scalar: DOUBLE, shape [], elements: 1")),
    }
}

/// Returns the value of a scalar of any integer type with 32 or 64 bits.
///
/// # Errors
/// If `tensor` is not an integer scalar, or not in `low` … `high`.
pub(super) fn integer(field: &str, tensor: &Tensor, low: u64, high: u64) -> Result<u64, Error> {
    let one = match (&tensor.payload, tensor.shape.as_slice()) {
        (Some(Payload::Int32s(i)), []) if i.array.len() == 1 => i128::from(i.array[0]),
        (Some(Payload::Int64s(i)), []) if i.array.len() == 1 => i128::from(i.array[0]),
        (Some(Payload::Uint32s(i)), []) if i.array.len() == 1 => i128::from(i.array[0]),
        (Some(Payload::Uint64s(i)), []) if i.array.len() == 1 => i128::from(i.array[0]),
        _ => return Err(refuse(field, tensor, "a scalar: INT64, INT32, UINT64 or UINT32, shape [], elements: 1")),
    };
    let within = u64::try_from(one).ok().filter(|n| (low..=high).contains(n));
    within.ok_or_else(|| Error::value(field.to_owned(), one, format!("an integer from {low} to {high}")))
}

/// Returns the elements of an INT32 tensor of this shape. A single element is broadcast to the whole shape. `bounds`
/// has one range for each element.
///
/// # Errors
/// If `tensor` has another type or shape, or an element is out of its bounds.
pub(super) fn int32s(field: &str, tensor: &Tensor, shape: &[usize], bounds: &[(i32, i32)]) -> Result<Vec<i32>, Error> {
    match &tensor.payload {
        Some(Payload::Int32s(given)) => elements(field, tensor, &given.array, shape, DataType::Int32, bounds),
        _ => Err(refuse(field, tensor, &describe(DataType::Int32, shape))),
    }
}

/// Returns the elements of a FLOAT tensor of this shape. A single element is broadcast to the whole shape. `bounds` has
/// one range for each element.
///
/// # Errors
/// If `tensor` has another type or shape, or an element is out of its bounds.
pub(super) fn floats(field: &str, tensor: &Tensor, shape: &[usize], bounds: &[(f32, f32)]) -> Result<Vec<f32>, Error> {
    match &tensor.payload {
        Some(Payload::Floats(given)) => elements(field, tensor, &given.array, shape, DataType::Float, bounds),
        _ => Err(refuse(field, tensor, &describe(DataType::Float, shape))),
    }
}

/// Checks the shape and bounds of a tensor with the elements `given`, and returns one element for each of `bounds`. As
/// in dm_env_rpc, a single element is broadcast to the whole shape, and a negative dimension is inferred from the
/// number of elements. A tensor may not use both rules.
fn elements<T: Copy + PartialOrd + Display>(
    field: &str,
    tensor: &Tensor,
    given: &[T],
    shape: &[usize],
    dtype: DataType,
    bounds: &[(T, T)],
) -> Result<Vec<T>, Error> {
    let refuse = || refuse(field, tensor, &describe(dtype, shape));
    let inferred = tensor.shape.iter().filter(|&&length| length < 0).count();
    let fits = |(&given, &wanted): (&i32, &usize)| given < 0 || usize::try_from(given).is_ok_and(|n| n == wanted);
    if tensor.shape.len() != shape.len() || inferred > 1 || !tensor.shape.iter().zip(shape).all(fits) {
        return Err(refuse());
    }
    let all = match given {
        [one] if inferred == 0 => vec![*one; bounds.len()],
        many if many.len() == bounds.len() => many.to_vec(),
        _ => return Err(refuse()),
    };
    // NaN is outside every interval, so it is refused.
    match all.iter().zip(bounds).position(|(x, (low, high))| !(low..=high).contains(&x)) {
        Some(i) => {
            let (got, (low, high)) = (format!("{} in element {i}", all[i]), bounds[i]);
            Err(Error::value(field.to_owned(), got, format!("a number within [{low}, {high}]")))
        }
        None => Ok(all),
    }
}

fn refuse(field: &str, tensor: &Tensor, expected: &str) -> Error {
    let got = match dtype_and_count(tensor) {
        Some((dtype, count)) => format!("{}, {}, elements: {count}", dtype.as_str_name(), shape_of(&tensor.shape)),
        None => "a tensor without a payload".into(),
    };
    Error::value(field.to_owned(), got, expected)
}

fn describe(dtype: DataType, shape: &[usize]) -> String {
    let count = match shape.iter().product() {
        1 => "1".into(),
        n => format!("{n}, or 1 for all"),
    };
    format!("{}, shape {shape:?}, elements: {count}", dtype.as_str_name())
}

fn shape_of(shape: &[i32]) -> String {
    match shape.len() {
        0..=MAX_SHOWN_DIMENSIONS => format!("shape {shape:?}"),
        n => format!("a shape of {n} dimensions"),
    }
}

/// Returns the type and the number of a tensor's elements, or `None` if it has no payload.
pub(super) fn dtype_and_count(tensor: &Tensor) -> Option<(DataType, usize)> {
    Some(match tensor.payload.as_ref()? {
        Payload::Floats(x) => (DataType::Float, x.array.len()),
        Payload::Doubles(x) => (DataType::Double, x.array.len()),
        Payload::Int8s(x) => (DataType::Int8, x.array.len()),
        Payload::Int32s(x) => (DataType::Int32, x.array.len()),
        Payload::Int64s(x) => (DataType::Int64, x.array.len()),
        Payload::Uint8s(x) => (DataType::Uint8, x.array.len()),
        Payload::Uint32s(x) => (DataType::Uint32, x.array.len()),
        Payload::Uint64s(x) => (DataType::Uint64, x.array.len()),
        Payload::Bools(x) => (DataType::Bool, x.array.len()),
        Payload::Strings(x) => (DataType::String, x.array.len()),
        Payload::Protos(x) => (DataType::Proto, x.array.len()),
    })
}

/// Makes a tensor of this shape. The shape of a scalar is empty.
pub(super) fn tensor(payload: Payload, shape: &[usize]) -> Tensor {
    // A length is at most the size of an observation or of the catalogue, so it fits in an i32.
    let shape = shape.iter().map(|&length| i32::try_from(length).unwrap_or(i32::MAX)).collect();
    Tensor { payload: Some(payload), shape }
}
