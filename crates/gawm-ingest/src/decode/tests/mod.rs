//! Tests of the decoders: against vectors and logs of other people's writers, and against hostile bytes.

mod cdr;
mod corpora;
mod damage;
mod encodings;
mod messages;

use std::path::PathBuf;

/// Returns the shared folder, or says that the test is skipped.
pub(crate) fn shared() -> Option<PathBuf> {
    let Some(path) = std::env::var_os("GAWM_SHARED").map(PathBuf::from) else {
        eprintln!("skipped: GAWM_SHARED is not set");
        return None;
    };
    assert!(path.is_dir(), "GAWM_SHARED is set but {path:?} is no folder");
    Some(path)
}
