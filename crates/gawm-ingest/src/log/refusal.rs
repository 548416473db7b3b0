//! What a file is when it is not MCAP, told from its first bytes, and what helps.

use std::fmt;
use std::path::Path;

use super::wire::MAGIC;

/// What a refused file is.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Foreign {
    /// MCAP whose CR LF were converted to LF, or LF to CR LF: the whole file went through a text-mode copy.
    TextModeCopy {
        /// What was converted to what.
        conversion: &'static str,
    },
    /// A ROS 1 bag.
    RosBag1,
    /// An SQLite database, which is what older rosbag2 bags are.
    Sqlite,
    /// A file under a compression of its own.
    Compressed {
        /// Name of the compression.
        name: &'static str,
    },
    /// A pointer that Git LFS leaves in the place of a file.
    GitLfsPointer,
    /// A file format that has its own door or none.
    Format {
        /// Name of the format.
        name: &'static str,
    },
    /// Text.
    Text {
        /// The first characters.
        start: String,
    },
    /// Only zero bytes at the start.
    Zeros,
    /// Anything else.
    Unknown {
        /// The first bytes, at most eight.
        start: Vec<u8>,
    },
}

/// First bytes and what they mean.
const SIGNATURES: &[(&[u8], Foreign)] = &[
    (b"\x89MCAP0\n", Foreign::TextModeCopy { conversion: "CR LF was converted to LF" }),
    (b"\x89MCAP0\r\r\n", Foreign::TextModeCopy { conversion: "LF was converted to CR LF" }),
    (b"\xc2\x89MCAP0", Foreign::TextModeCopy { conversion: "Latin-1 was converted to UTF-8" }),
    (
        b"\xef\xbf\xbdMCAP0",
        Foreign::TextModeCopy { conversion: "bytes that are not UTF-8 were replaced by U+FFFD" },
    ),
    (b"#ROSBAG V", Foreign::RosBag1),
    (b"SQLite format 3\0", Foreign::Sqlite),
    (b"\x28\xb5\x2f\xfd", Foreign::Compressed { name: "zstd" }),
    (b"\x1f\x8b", Foreign::Compressed { name: "gzip" }),
    (b"\x04\x22\x4d\x18", Foreign::Compressed { name: "lz4" }),
    (b"BZh", Foreign::Compressed { name: "bzip2" }),
    (b"\xfd7zXZ\0", Foreign::Compressed { name: "xz" }),
    (b"version https://git-lfs", Foreign::GitLfsPointer),
    (b"PK\x03\x04", Foreign::Format { name: "zip (or npz)" }),
    (b"\x89HDF\r\n\x1a\n", Foreign::Format { name: "HDF5" }),
    (b"PAR1", Foreign::Format { name: "Parquet" }),
    (b"\x93NUMPY", Foreign::Format { name: "npy" }),
    (b"\x80\x04\x95", Foreign::Format { name: "Python pickle" }),
];

impl Foreign {
    /// Tells from its first bytes what a file is; the bytes are not the MCAP magic.
    pub(crate) fn identify(start: &[u8]) -> Self {
        if let Some((_, found)) = SIGNATURES.iter().find(|(signature, _)| start.starts_with(signature)) {
            return found.clone();
        }
        if start.iter().all(|&byte| byte == 0) {
            return Self::Zeros;
        }
        let is_text = |byte: &u8| matches!(byte, b'\t' | b'\n' | b'\r' | 0x20..=0x7e);
        if start.len() >= 4 && start.iter().all(is_text) {
            let line = start.split(|&byte| byte == b'\n').next().unwrap_or_default();
            return Self::Text {
                start: String::from_utf8_lossy(&line[..line.len().min(40)]).trim_end().to_owned(),
            };
        }
        Self::Unknown { start: start[..start.len().min(MAGIC.len())].to_vec() }
    }

    /// Returns what to do with such a file.
    pub fn hint(&self, path: &Path) -> Option<String> {
        let name = path.file_name().map_or_else(|| "FILE".into(), |name| name.to_string_lossy());
        let target = Path::new(name.as_ref()).with_extension("mcap");
        let target = target.display();
        match self {
            Self::TextModeCopy { .. } => Some(
                "every such byte pair in the file is damaged and cannot be told apart; copy it again in binary mode \
                 (git: `*.mcap binary` in .gitattributes; ftp: `binary`)"
                    .to_owned(),
            ),
            Self::RosBag1 | Self::Sqlite => Some(format!("convert it first: mcap convert {name} {target}")),
            Self::Compressed { name: compression } => {
                let tool = match *compression {
                    "zstd" => "zstd -d",
                    "gzip" => "gunzip",
                    "lz4" => "lz4 -d",
                    "bzip2" => "bunzip2",
                    _ => "xz -d",
                };
                Some(format!("decompress it first: {tool} {name}"))
            }
            Self::GitLfsPointer => Some("fetch the file itself: git lfs pull".to_owned()),
            Self::Format { .. } | Self::Text { .. } | Self::Unknown { .. } => None,
            Self::Zeros => Some("a power cut or a failed copy leaves such files; copy it again from the robot".to_owned()),
        }
    }
}

impl fmt::Display for Foreign {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::TextModeCopy { conversion } => {
                write!(f, "an MCAP file that went through a text-mode copy ({conversion})")
            }
            Self::RosBag1 => f.write_str("a ROS 1 bag"),
            Self::Sqlite => f.write_str("an sqlite3 database (a rosbag2 .db3 bag is one)"),
            Self::Compressed { name } => write!(f, "a file compressed as a whole with {name}"),
            Self::GitLfsPointer => f.write_str("a Git LFS pointer"),
            Self::Format { name } => write!(f, "a file of the format {name}"),
            Self::Text { start } => write!(f, "text that starts with {start:?}"),
            Self::Zeros => f.write_str("zero bytes"),
            Self::Unknown { start } => {
                f.write_str("bytes")?;
                start.iter().try_for_each(|byte| write!(f, " {byte:02x}"))
            }
        }
    }
}
