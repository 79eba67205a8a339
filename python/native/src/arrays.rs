//! Conversion of the protocol's bytes to NumPy arrays.
//!
//! Each array is a copy, because numbers in a received message may be misaligned. NumPy is slow with misaligned arrays,
//! and PyTorch refuses them. Python may change the arrays.

use numpy::ndarray::Array2;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

use crate::failure::{MALFORMED, failure};

/// Maximum length of a row for which [`row`] is faster than [`floats`].
const MAX_SHORT_ROW: usize = 64;

/// Returns the bytes as an array, float32 `[n]`.
///
/// # Errors
/// If the bytes are not `n` numbers.
pub fn floats<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<f32>>> {
    Ok(PyArray1::from_vec(py, numbers(data, &[n])?))
}

/// Returns the bytes as an array, float32 `[rows, columns]`.
///
/// # Errors
/// If the bytes are not `rows · columns` numbers.
pub fn rows<'py>(py: Python<'py>, data: &[u8], rows: usize, columns: usize) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let numbers = Array2::from_shape_vec([rows, columns], numbers(data, &[rows, columns])?);
    Ok(PyArray2::from_owned_array(py, numbers.map_err(|error| failure(MALFORMED, 0, error.to_string()))?))
}

/// Returns the bytes as an array, float32 `[n]`. It is faster than [`floats`] for short rows, because it copies them
/// into memory that NumPy allocates.
///
/// # Errors
/// If the bytes are not `n` numbers.
pub fn row<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let (mut row, (words, rest)) = ([0.0; MAX_SHORT_ROW], data.as_chunks::<4>());
    if words.len() != n || !rest.is_empty() || n > MAX_SHORT_ROW {
        return floats(py, data, n);
    }
    row.iter_mut().zip(words).for_each(|(number, word)| *number = f32::from_le_bytes(*word));
    Ok(PyArray1::from_slice(py, &row[..n]))
}

/// Returns the bytes as an array, bool `[n]`. Each byte that is not 0 is true.
///
/// # Errors
/// If there are not `n` bytes.
pub fn flags<'py>(py: Python<'py>, data: &[u8], n: usize) -> PyResult<Bound<'py, PyArray1<bool>>> {
    if data.len() != n {
        return Err(failure(MALFORMED, 0, format!("the server sent {} flags; expected {n}", data.len())));
    }
    Ok(PyArray1::from_vec(py, data.iter().map(|&flag| flag != 0).collect()))
}

/// Returns the pixels as an array, uint8 `[height, width, 3]`. The caller has checked the number of bytes.
///
/// # Errors
/// If NumPy cannot reshape the array.
pub fn picture<'py>(py: Python<'py>, data: &[u8], size: [usize; 3]) -> PyResult<Bound<'py, PyArray3<u8>>> {
    PyArray1::from_slice(py, data).reshape(size)
}

/// Decodes little-endian float32 numbers.
///
/// # Errors
/// If the number of bytes does not fit an array of this shape.
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
