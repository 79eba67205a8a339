//! The protocol's bytes as NumPy arrays.
//!
//! Numbers are copied once, out of the received message into memory of the array's own: within the message they lie at
//! any address, where NumPy would be slow and PyTorch refuse them.

use numpy::ndarray::Array2;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

use crate::failure::{MALFORMED, failure};

/// Length of rows that are short.
const MAX_SHORT_ROW: usize = 64;

/// float32 `[n]`, to change.
///
/// # Errors
/// If there are more or fewer.
pub fn floats<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<f32>>> {
    Ok(PyArray1::from_vec(py, numbers(data, &[n])?))
}

/// float32 `[rows, columns]`, to change.
///
/// # Errors
/// If there are more or fewer.
pub fn rows<'py>(py: Python<'py>, data: &[u8], rows: usize, columns: usize) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let numbers = Array2::from_shape_vec([rows, columns], numbers(data, &[rows, columns])?);
    Ok(PyArray2::from_owned_array(py, numbers.map_err(|error| failure(MALFORMED, 0, error.to_string()))?))
}

/// float32 `[n]` of few numbers, to change: memory of NumPy's costs less than a vector that it has to free.
///
/// # Errors
/// If there are more or fewer.
pub fn row<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let (mut row, (words, rest)) = ([0.0; MAX_SHORT_ROW], data.as_chunks::<4>());
    if words.len() != n || !rest.is_empty() || n > MAX_SHORT_ROW {
        return floats(py, data, n);
    }
    row.iter_mut().zip(words).for_each(|(number, word)| *number = f32::from_le_bytes(*word));
    Ok(PyArray1::from_slice(py, &row[..n]))
}

/// bool `[n]`, to change.
///
/// # Errors
/// If there are more or fewer.
pub fn flags<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<bool>>> {
    if data.len() != n {
        return Err(failure(MALFORMED, 0, format!("the server sent {} flags; expected {n}", data.len())));
    }
    Ok(PyArray1::from_vec(py, data.iter().map(|&flag| flag != 0).collect()))
}

/// uint8 `[height, width, 3]`, to change; the caller has compared the sizes.
///
/// # Errors
/// NumPy's.
pub fn picture<'py>(py: Python<'py>, data: &[u8], size: [usize; 3]) -> PyResult<Bound<'py, PyArray3<u8>>> {
    PyArray1::from_slice(py, data).reshape(size)
}

/// Little-endian float32 numbers, as many as an array of this shape has.
///
/// # Errors
/// If there are more or fewer.
pub fn numbers(data: &[u8], shape: &[usize]) -> PyResult<Vec<f32>> {
    let (words, rest) = data.as_chunks::<4>();
    let expected = shape.iter().try_fold(1_usize, |size, length| size.checked_mul(*length));
    if Some(words.len()) != expected || !rest.is_empty() {
        let size = expected.and_then(|expected| expected.checked_mul(4)).unwrap_or(usize::MAX);
        let words = format!("the server sent {} bytes for float32 {shape:?}; expected {size}", data.len());
        return Err(failure(MALFORMED, 0, words));
    }
    Ok(words.iter().map(|word| f32::from_le_bytes(*word)).collect())
}
