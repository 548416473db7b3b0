//! PyTorch files (`torch.save` of a state dict): a zip archive of a pickle and one file per storage.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{Device, Tensor};
use thiserror::Error;

use super::archive::Archive;
use super::pickle::{PickleError, TensorRecord, read_state_dict};

/// Longest pickle that is read; that of a state dict of a thousand tensors has 200 kB.
const MAX_PICKLE_BYTES: u64 = 16 << 20;

/// Why a file is refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TorchError {
    /// The file system or the archive refuses.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// The archive is damaged.
    #[error("damaged archive: {message}")]
    Archive {
        /// What is wrong.
        message: &'static str,
    },
    /// The bytes of an entry are not those that were written.
    #[error("damaged entry {name:?}: wrong checksum")]
    Checksum {
        /// The entry.
        name: String,
    },
    /// The archive has no pickle, or several.
    #[error("expected one data.pkl in the archive, got {got}")]
    NoPickle {
        /// How many there are.
        got: usize,
    },
    /// A file in the archive is packed, which PyTorch never does.
    #[error("compressed entry {name:?}: expected stored bytes as torch.save writes them")]
    Compressed {
        /// The entry.
        name: String,
    },
    /// A file in the archive is too long or too short.
    #[error("wrong size of {name:?}: expected {expected} bytes, got {got}")]
    Size {
        /// The entry.
        name: String,
        /// The size that its use needs, or the largest allowed.
        expected: u64,
        /// Its size.
        got: u64,
    },
    /// Numbers are stored in the other byte order.
    #[error("expected little-endian numbers, got {got:?}")]
    ByteOrder {
        /// What the archive says.
        got: String,
    },
    /// The pickle is no state dict.
    #[error(transparent)]
    Pickle(#[from] PickleError),
    /// A tensor reaches beyond its storage.
    #[error("tensor {name:?} with shape {shape:?} does not fit into its storage of {storage_len} elements")]
    View {
        /// The tensor.
        name: String,
        /// Its shape.
        shape: Vec<usize>,
        /// Elements in the storage.
        storage_len: usize,
    },
    /// No tensor of this name.
    #[error("no tensor {name:?}")]
    Missing {
        /// The name.
        name: String,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

/// An open file whose pickle has been read; tensors are read one by one.
pub(super) struct TorchFile {
    archive: Archive,
    folder: String,
    records: BTreeMap<String, TensorRecord>,
}

impl TorchFile {
    /// Opens an archive and runs its pickle.
    pub(super) fn open(path: &Path) -> Result<TorchFile, TorchError> {
        let mut archive = Archive::open(path)?;
        let pickles: Vec<&str> = archive.names().filter(|name| name.ends_with("/data.pkl")).collect();
        let &[pickle] = pickles.as_slice() else {
            return Err(TorchError::NoPickle { got: pickles.len() });
        };
        let pickle = pickle.to_owned();
        let folder = pickle.trim_end_matches("data.pkl").to_owned();
        let byte_order = format!("{folder}byteorder");
        if archive.contains(&byte_order) {
            let order = archive.read(&byte_order, 0..=16)?;
            if order != b"little" {
                return Err(TorchError::ByteOrder { got: String::from_utf8_lossy(&order).into_owned() });
            }
        }
        let program = archive.read(&pickle, 0..=MAX_PICKLE_BYTES)?;
        let records: BTreeMap<String, TensorRecord> = read_state_dict(&program)?.into_iter().collect();
        for (name, record) in &records {
            check_view(name, record)?;
        }
        Ok(TorchFile { archive, folder, records })
    }

    /// Names and shapes, sorted by name.
    pub(super) fn shapes(&self) -> impl Iterator<Item = (String, Vec<usize>)> {
        self.records.iter().map(|(name, record)| (name.clone(), record.shape.clone()))
    }

    /// Reads one tensor.
    pub(super) fn read(&mut self, name: &str) -> Result<Tensor, TorchError> {
        let missing = || TorchError::Missing { name: name.to_owned() };
        let record = self.records.get(name).ok_or_else(missing)?;
        let expected = record.storage_len as u64 * record.dtype.size_in_bytes() as u64; // checked by `check_view`
        let storage = format!("{}data/{}", self.folder, record.storage);
        let bytes = self.archive.read(&storage, expected..=expected)?;
        let bytes = gather(&bytes, record);
        Ok(Tensor::from_raw_buffer(&bytes, record.dtype, &record.shape, &Device::Cpu)?)
    }
}

/// Checks that a view lies within its storage and is no larger than it.
fn check_view(name: &str, record: &TensorRecord) -> Result<(), TorchError> {
    let elements = record.shape.iter().try_fold(1usize, |product, &dim| product.checked_mul(dim));
    let last = record.shape.iter().zip(&record.stride).try_fold(record.offset, |last, (&dim, &stride)| {
        last.checked_add(dim.saturating_sub(1).checked_mul(stride)?)
    });
    let bytes = record.storage_len.checked_mul(record.dtype.size_in_bytes());
    let fits = match (elements, last, bytes) {
        (Some(0), _, Some(_)) => true,
        (Some(elements), Some(last), Some(_)) => elements <= record.storage_len && last < record.storage_len,
        _ => false,
    };
    if fits {
        return Ok(());
    }
    let (shape, storage_len) = (record.shape.clone(), record.storage_len);
    Err(TorchError::View { name: name.to_owned(), shape, storage_len })
}

/// Copies the elements of a view, row-major.
fn gather(storage: &[u8], record: &TensorRecord) -> Vec<u8> {
    let size = record.dtype.size_in_bytes();
    let mut elements = vec![record.offset];
    for (&dim, &stride) in record.shape.iter().zip(&record.stride) {
        elements = elements.iter().flat_map(|&first| (0..dim).map(move |i| first + i * stride)).collect();
    }
    elements.iter().flat_map(|&element| &storage[element * size..(element + 1) * size]).copied().collect()
}
