//! Reading and writing of arrays as safetensors files.

use std::collections::HashMap;

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use perturb_policy::{NamedArray, PolicySpec, Weights};

/// The key of the checkpoint's JSON document in the metadata of a safetensors file.
const DOCUMENT: &str = "perturb";

/// An array to be written. Its elements are in `bytes`, little-endian.
#[derive(Clone, Debug)]
pub struct Array {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Array {
    /// Creates an array of f32 with any shape.
    pub fn f32(name: impl Into<String>, shape: Vec<usize>, data: &[f32]) -> Self {
        let bytes = data.iter().flat_map(|x| x.to_le_bytes()).collect();
        Self { name: name.into(), dtype: Dtype::F32, shape, bytes }
    }

    /// Creates a one-dimensional array of u64.
    pub fn u64(name: &str, data: impl ExactSizeIterator<Item = u64>) -> Self {
        let shape = vec![data.len()];
        Self { name: name.to_owned(), dtype: Dtype::U64, shape, bytes: data.flat_map(u64::to_le_bytes).collect() }
    }

    /// Creates a one-dimensional array of bytes.
    pub fn u8(name: &str, bytes: Vec<u8>) -> Self {
        Self { name: name.to_owned(), dtype: Dtype::U8, shape: vec![bytes.len()], bytes }
    }
}

/// Encodes `arrays` as a safetensors file.
///
/// # Errors
/// A description of the fault, for example two arrays with the same name.
pub fn encode(arrays: &[Array]) -> Result<Vec<u8>, String> {
    encode_with(arrays, "format", "perturb".to_owned())
}

/// Encodes `arrays` as a safetensors file with one entry of metadata. There is only one, because safetensors would
/// write several entries in an order that changes from run to run.
fn encode_with(arrays: &[Array], key: &str, value: String) -> Result<Vec<u8>, String> {
    let views: Vec<(&str, TensorView<'_>)> = arrays
        .iter()
        .map(|Array { name, dtype, shape, bytes }| Ok((name.as_str(), TensorView::new(*dtype, shape.clone(), bytes)?)))
        .collect::<Result<_, safetensors::SafeTensorError>>()
        .map_err(|error| error.to_string())?;
    let metadata = HashMap::from([(key.to_owned(), value)]);
    safetensors::serialize(views, Some(metadata)).map_err(|error| error.to_string())
}

/// The arrays of a safetensors file.
#[derive(Debug)]
pub struct Arrays<'a>(SafeTensors<'a>);

impl<'a> Arrays<'a> {
    /// Parses a safetensors file.
    ///
    /// # Errors
    /// A description of the fault if the file is not valid.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, String> {
        SafeTensors::deserialize(bytes).map(Self).map_err(|error| error.to_string())
    }

    /// Returns the array called `name`, with its shape.
    ///
    /// # Errors
    /// A description of the fault if the array is missing or has another type.
    pub fn f32(&self, name: &str) -> Result<NamedArray, String> {
        let tensor = self.get(name, Dtype::F32)?;
        let data = tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        Ok(NamedArray { name: name.to_owned(), shape: tensor.shape().to_vec(), data })
    }

    /// Returns the elements of the array called `name`.
    ///
    /// # Errors
    /// A description of the fault if the array is missing or has another type.
    pub fn u64(&self, name: &str) -> Result<Vec<u64>, String> {
        let tensor = self.get(name, Dtype::U64)?;
        Ok(tensor.data().as_chunks::<8>().0.iter().map(|bytes| u64::from_le_bytes(*bytes)).collect())
    }

    /// Returns the elements of the array called `name`.
    ///
    /// # Errors
    /// A description of the fault if the array is missing or has another type.
    pub fn u8(&self, name: &str) -> Result<&'a [u8], String> {
        Ok(self.get(name, Dtype::U8)?.data())
    }

    fn get(&self, name: &str, dtype: Dtype) -> Result<TensorView<'a>, String> {
        let tensor = self.0.tensor(name).map_err(|error| error.to_string())?;
        if tensor.dtype() != dtype {
            return Err(format!("{name} has the type {:?}, expected {dtype:?}", tensor.dtype()));
        }
        Ok(tensor)
    }
}

pub(super) fn encode_weights(weights: &Weights) -> Result<Vec<u8>, String> {
    encode(&arrays_of(weights))
}

/// Encodes `weights` as a safetensors file that contains the checkpoint's JSON document in its metadata.
pub(super) fn encode_policy(weights: &Weights, document: String) -> Result<Vec<u8>, String> {
    encode_with(&arrays_of(weights), DOCUMENT, document)
}

/// Reads the checkpoint's JSON document from the metadata of a safetensors file.
pub(super) fn decode_document(bytes: &[u8]) -> Result<String, String> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
    let document = metadata.metadata().as_ref().and_then(|entries| entries.get(DOCUMENT)).cloned();
    document.ok_or_else(|| format!("its metadata have no `{DOCUMENT}`: give a file that `perturb export` wrote"))
}

fn arrays_of(weights: &Weights) -> Vec<Array> {
    weights.iter().map(|array| Array::f32(&array.name, array.shape.clone(), &array.data)).collect()
}

pub(super) fn decode_weights(bytes: &[u8], spec: &PolicySpec) -> Result<Weights, String> {
    spec.validate().map_err(|error| error.to_string())?;
    let arrays = Arrays::decode(bytes)?;
    let layout = spec.layout();
    if arrays.0.len() != layout.len() {
        return Err(format!("it has {} arrays, expected {}", arrays.0.len(), layout.len()));
    }
    let weights = layout.iter().map(|(name, _)| arrays.f32(name)).collect::<Result<Weights, _>>()?;
    spec.check(&weights).map_err(|error| error.to_string())?;
    Ok(weights)
}
