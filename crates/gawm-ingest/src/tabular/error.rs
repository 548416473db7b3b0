//! What can go wrong when a tabular file is opened or read.

use std::path::PathBuf;

/// Why a tabular file could not be opened at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenTableError {
    /// The operating system refused the file.
    #[error("cannot read {path:?}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// The file has no bytes.
    #[error("file is empty: expected HDF5 or npz, got 0 bytes: {path:?}")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The content is neither HDF5 nor npz.
    #[error("not a tabular file: expected HDF5 or npz, got {got}: {path:?}")]
    NotTabular {
        /// The file.
        path: PathBuf,
        /// What the first bytes look like.
        got: String,
    },
    /// The file starts as HDF5, but its superblock or root group cannot be read.
    #[error("damaged HDF5 file: {detail}: {path:?}")]
    Hdf5 {
        /// The file.
        path: PathBuf,
        /// What was found.
        detail: String,
    },
    /// The file starts as a zip archive, but its directory cannot be read.
    #[error("damaged npz file: {detail}: {path:?}")]
    Npz {
        /// The file.
        path: PathBuf,
        /// What was found.
        detail: String,
    },
    /// A zip archive holds something else than arrays.
    #[error("not an npz file: expected .npy entries, got {got:?}: {path:?}")]
    NotArrays {
        /// The file.
        path: PathBuf,
        /// The first entry that is no array.
        got: String,
    },
    /// More datasets, or deeper groups, than the limits allow.
    #[error("too many {what}: limit {limit}: {path:?}")]
    TooMany {
        /// The file.
        path: PathBuf,
        /// What there is too much of.
        what: &'static str,
        /// The limit that was met.
        limit: u64,
    },
}

impl OpenTableError {
    /// Says what the user can do about it, if anything.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::Empty { .. } => Some("the copy or the recording did not finish; fetch it again"),
            Self::NotTabular { got, .. } if got.contains("npy") => {
                Some("one bare array has no column names; store it with numpy.savez")
            }
            Self::NotTabular { got, .. } if got.contains("LFS") => {
                Some("this is a pointer to the file; fetch it with `git lfs pull`")
            }
            Self::Npz { .. } => Some(
                "an npz keeps its directory at its end, so a cut file cannot be read; \
                 fetch or write it again",
            ),
            Self::Hdf5 { .. } => Some("check the copy, for example with `h5dump -H`"),
            Self::TooMany { .. } => Some("the limit guards against hostile files; it can be raised"),
            _ => None,
        }
    }
}

/// Why values of one column could not be read.
///
/// Cloned freely, since a damaged chunk index answers every later read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The file has no such column.
    #[error("no column {column:?}: expected one of {known}")]
    UnknownColumn {
        /// What was asked for.
        column: String,
        /// The columns there are, shortened.
        known: String,
    },
    /// Rows beyond the end were asked for.
    #[error("rows {start}..{end} of {column:?} are out of range: expected at most {rows} rows")]
    RowsOutOfRange {
        /// The column.
        column: String,
        /// First row asked for.
        start: u64,
        /// One past the last row asked for.
        end: u64,
        /// How many there are.
        rows: u64,
    },
    /// The column is compressed by a filter that this program does not have.
    #[error(
        "column {column:?} needs HDF5 filter {id} ({name}): expected deflate, shuffle, fletcher32, szip, nbit, scaleoffset, lz4 or blosc"
    )]
    UnsupportedFilter {
        /// The column.
        column: String,
        /// Registered filter id.
        id: u16,
        /// Its name.
        name: String,
    },
    /// The values are of a kind that is no column here.
    #[error("column {column:?} holds {got}: expected numbers, booleans or text")]
    UnsupportedType {
        /// The column.
        column: String,
        /// What it holds.
        got: String,
    },
    /// The array is a Python pickle, which could run code when it is loaded.
    #[error("column {column:?} holds pickled Python objects: expected a plain array")]
    Pickled {
        /// The column.
        column: String,
    },
    /// The dataset's bytes lie in other datasets.
    #[error("column {column:?} is a virtual dataset: expected data in this file")]
    Virtual {
        /// The column.
        column: String,
    },
    /// The dataset's bytes lie in another file.
    #[error("column {column:?} is stored in other files: expected data in this file")]
    External {
        /// The column.
        column: String,
    },
    /// The bytes contradict the format.
    #[error("column {column:?} is damaged: {detail}")]
    Damaged {
        /// The column.
        column: String,
        /// What was expected and found, and where.
        detail: String,
    },
    /// One read, chunk or array is larger than the limits allow.
    #[error("{what} of column {column:?} is too large: expected at most {limit} bytes, got {got}")]
    TooLarge {
        /// The column.
        column: String,
        /// What is too large.
        what: &'static str,
        /// The limit in bytes.
        limit: u64,
        /// The size in bytes, saturated.
        got: u64,
    },
    /// The values are of another kind than asked for.
    #[error("column {column:?} cannot be read as {wanted}: got {got}")]
    WrongKind {
        /// The column.
        column: String,
        /// What was asked for.
        wanted: &'static str,
        /// What it is.
        got: String,
    },
    /// The operating system failed while reading.
    #[error("cannot read column {column:?}: {detail}")]
    Io {
        /// The column.
        column: String,
        /// What the operating system said.
        detail: String,
    },
}

impl ReadError {
    /// Says what the user can do about it, if anything.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::UnsupportedFilter { id, .. } => Some(filter_hint(*id)),
            Self::Pickled { .. } => Some(
                "a pickle can run code when it is loaded, so it is never opened; \
                 save plain arrays, one per episode, with allow_pickle=False",
            ),
            Self::Virtual { .. } => Some("copy the data into one file: `h5repack` or h5py"),
            Self::External { .. } => Some("copy the data into one file: `h5repack`"),
            Self::TooLarge { .. } => Some("the limit guards against hostile files; it can be raised"),
            Self::UnsupportedType { .. } => Some("leave the column out, or store it as plain numbers"),
            _ => None,
        }
    }
}

fn filter_hint(id: u16) -> &'static str {
    match id {
        32000 => "rewrite with compression=\"gzip\" through h5py, which has LZF built in",
        _ => "rewrite with gzip where the plugin is installed: `h5repack -f GZIP=4 in.h5 out.h5`",
    }
}
