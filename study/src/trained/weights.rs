//! Weights as safetensors, a format that other tools read.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use perturb_policy::{NamedArray, PolicySpec, Weights};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::Deserialize;

use crate::files::{self, FileError};

/// Names a file and says how to tell whether it is whole.
#[derive(Deserialize)]
pub(super) struct WeightsFile {
    file: String,
    bytes: u64,
    crc32c: u32,
}

impl WeightsFile {
    /// Where it is: in the folder, whatever its name says.
    pub(super) fn path(&self, directory: &Path) -> PathBuf {
        directory.join(Path::new(&self.file).file_name().unwrap_or_default())
    }

    /// Its content, or what is wrong with it.
    pub(super) fn read(&self, directory: &Path) -> Result<Result<Vec<u8>, String>, FileError> {
        let content = files::read(&self.path(directory))?;
        if content.len() as u64 != self.bytes || crc32c::crc32c(&content) != self.crc32c {
            let (got, expected) = (content.len(), self.bytes);
            return Ok(Err(format!("it has {got} bytes, expected {expected} with another checksum")));
        }
        Ok(Ok(content))
    }
}

/// The weights of a policy of `spec`.
pub(super) fn decode(bytes: &[u8], spec: &PolicySpec) -> Result<Weights, String> {
    spec.validate().map_err(|error| error.to_string())?;
    let arrays = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
    let layout = spec.layout();
    if arrays.len() != layout.len() {
        return Err(format!("it has {} arrays, expected {}", arrays.len(), layout.len()));
    }
    let array = |name: &String| {
        let tensor = arrays.tensor(name).map_err(|error| error.to_string())?;
        if tensor.dtype() != Dtype::F32 {
            return Err(format!("{name} has the type {:?}, expected {:?}", tensor.dtype(), Dtype::F32));
        }
        let data = tensor.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        Ok(NamedArray { name: name.clone(), shape: tensor.shape().to_vec(), data })
    };
    let weights = layout.iter().map(|(name, _)| array(name)).collect::<Result<Weights, String>>()?;
    spec.check(&weights).map_err(|error| error.to_string())?;
    Ok(weights)
}

/// A file of `weights`, the bytes that the learner writes.
pub(super) fn encode(weights: &Weights) -> Result<Vec<u8>, String> {
    let bytes = |array: &NamedArray| array.data.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let bytes: Vec<Vec<u8>> = weights.iter().map(bytes).collect();
    let views = weights
        .iter()
        .zip(&bytes)
        .map(|(array, bytes)| Ok((array.name.as_str(), TensorView::new(Dtype::F32, array.shape.clone(), bytes)?)));
    let views = views.collect::<Result<Vec<_>, safetensors::SafeTensorError>>().map_err(|error| error.to_string())?;
    let metadata = HashMap::from([("format".to_owned(), "perturb".to_owned())]);
    safetensors::serialize(views, Some(metadata)).map_err(|error| error.to_string())
}
