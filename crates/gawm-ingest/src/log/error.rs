//! Why a log cannot be opened, and why a part of it cannot be read.

use std::io;
use std::path::PathBuf;

use super::refusal::Foreign;

/// Why a file is refused as a log.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenLogError {
    /// The operating system refused.
    #[error("cannot read {path:?}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The path is a folder or something else that has no bytes to read.
    #[error("not a file: expected an MCAP file, got a folder or a device: {path:?}")]
    NotAFile {
        /// The path.
        path: PathBuf,
    },
    /// The file has no bytes.
    #[error("empty file: expected an MCAP file, got 0 bytes: {path:?}")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The file starts like something else.
    #[error("not an MCAP file: expected the magic 89 4d 43 41 50 30 0d 0a, got {found}: {path:?}")]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// What it is instead.
        found: Foreign,
    },
    /// A folder holds no log.
    #[error(
        "no log in this folder: expected .mcap, .h5, .hdf5 or .npz files or a LeRobot dataset, got none: {path:?}"
    )]
    EmptyFolder {
        /// The folder.
        path: PathBuf,
    },
    /// The metadata of a rosbag2 folder cannot be used.
    #[error("bad rosbag2 metadata: {reason}: {path:?}")]
    BadRosbag2Metadata {
        /// The metadata file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A part that the metadata of a rosbag2 folder lists is not there.
    #[error("a part of the recording is missing: expected {part:?} beside {path:?}")]
    MissingPart {
        /// The metadata file.
        path: PathBuf,
        /// The part it lists.
        part: String,
    },
}

impl OpenLogError {
    /// Returns what to do about it, where there is something to do.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::NotMcap { path, found } => found.hint(path),
            Self::NotAFile { .. } => Some("name a .mcap file, or a folder that holds some".to_owned()),
            Self::Empty { .. } => {
                Some("the recorder wrote nothing, or a copy failed; copy it again from the robot".to_owned())
            }
            Self::EmptyFolder { .. } => Some("name the folder that holds the logs".to_owned()),
            Self::BadRosbag2Metadata { .. } => Some(
                "repair it with `ros2 bag reindex`, or name the .mcap files instead of the folder".to_owned(),
            ),
            Self::MissingPart { .. } => Some(
                "copy the missing part, or name the .mcap files that are there instead of the folder"
                    .to_owned(),
            ),
            Self::Io { .. } => None,
        }
    }

    /// Returns the file or folder that the error is about.
    pub fn path(&self) -> &std::path::Path {
        match self {
            Self::Io { path, .. }
            | Self::NotAFile { path }
            | Self::Empty { path }
            | Self::NotMcap { path, .. }
            | Self::EmptyFolder { path }
            | Self::BadRosbag2Metadata { path, .. }
            | Self::MissingPart { path, .. } => path,
        }
    }
}

/// Why an attachment or a message body cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// There is no attachment with this number.
    #[error("no attachment {index}: expected less than {count}")]
    NoSuchAttachment {
        /// The number asked for.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// The data is larger than the limit.
    #[error("{what} too large: expected at most {limit} bytes, got {size}")]
    TooLarge {
        /// What was to be read.
        what: &'static str,
        /// Its size.
        size: u64,
        /// The limit.
        limit: u64,
    },
    /// The operating system refused.
    #[error("cannot read {what} at offset {offset}: {source}")]
    Io {
        /// What was to be read.
        what: &'static str,
        /// Where it lies.
        offset: u64,
        /// The system's reason.
        source: io::Error,
    },
    /// The CRC differs.
    #[error("attachment CRC mismatch at offset {offset}: expected {expected:#010x}, got {got:#010x}")]
    AttachmentCrc {
        /// Where the record lies.
        offset: u64,
        /// The CRC in the file.
        expected: u32,
        /// The CRC of the bytes.
        got: u32,
    },
    /// A compressed message body cannot be decompressed.
    #[error("cannot decompress the message body: {reason}")]
    Decompress {
        /// The decompressor's reason.
        reason: String,
    },
}
