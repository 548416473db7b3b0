//! Log files that rosbag2 compressed as a whole (`x_0.mcap.zstd`): unpacked into a temporary file, since logs are read
//! by position.

use std::fs::File;
use std::io::{self, BufReader, Read as _, Write as _};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

/// What may come of a compressed file: this many times its size, and this much besides.
const MAX_RATIO: u64 = 1000;
const MAX_EXTRA_BYTES: u64 = 1 << 30;

/// Why a compressed log cannot be unpacked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum UnpackError {
    /// It cannot be read, or its zstd frame is damaged.
    #[error("cannot unpack {path:?}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The temporary file cannot be written.
    #[error("cannot unpack {path:?} into a temporary file: {source}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It becomes larger than any log would.
    #[error("cannot unpack {path:?}: expected at most {limit} bytes, got more")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The cap.
        limit: u64,
    },
}

/// Returns whether a file is a log under a compression of its own, by its name and first bytes.
pub(crate) fn is_packed(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    if !(name.ends_with(".mcap.zstd") || name.ends_with(".mcap.zst")) {
        return false;
    }
    let mut magic = [0; 4];
    File::open(path).and_then(|mut file| file.read_exact(&mut magic)).is_ok()
        && magic == [0x28, 0xb5, 0x2f, 0xfd]
}

/// Unpacks a file; the temporary one is removed when it is dropped.
pub(crate) fn unpack(path: &Path) -> Result<NamedTempFile, UnpackError> {
    let read = |source| UnpackError::Read { path: path.to_owned(), source };
    let write = |source| UnpackError::Write { path: path.to_owned(), source };
    let file = File::open(path).map_err(read)?;
    let limit =
        file.metadata().map_err(read)?.len().saturating_mul(MAX_RATIO).saturating_add(MAX_EXTRA_BYTES);
    let mut decoder = zstd::Decoder::with_buffer(BufReader::new(file)).map_err(read)?;
    let mut out = tempfile::Builder::new().prefix("gawm-").suffix(".mcap").tempfile().map_err(write)?;
    let (mut buffer, mut total) = (vec![0; 1 << 20], 0_u64);
    loop {
        let n = decoder.read(&mut buffer).map_err(read)?;
        if n == 0 {
            break;
        }
        total += n as u64;
        if total > limit {
            return Err(UnpackError::TooLarge { path: path.to_owned(), limit });
        }
        out.write_all(&buffer[..n]).map_err(write)?;
    }
    out.flush().map_err(write)?;
    Ok(out)
}
