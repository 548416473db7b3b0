//! Files of ours as memory: the only place of the workspace that maps files.
//!
//! It is here, and not with the cache that uses it, so that the loader's crate forbids unsafe code.
#![expect(
    unsafe_code,
    reason = "a mapped file changes when someone writes to it, which the compiler cannot see"
)]

use std::fs::File;
use std::ops::Deref;
use std::path::Path;

use memmap2::Mmap;

/// A file in memory, shared by all processes that map it; read-only.
///
/// The file must be finished: written under another name, renamed when whole, never changed after. Whoever truncates it
/// while it is mapped kills the processes that read it (SIGBUS).
#[derive(Debug)]
pub struct MappedFile {
    map: Mmap,
}

impl MappedFile {
    /// Maps a whole file.
    ///
    /// # Errors
    /// The file cannot be opened or mapped; an empty file cannot.
    pub fn open(path: &Path) -> std::io::Result<MappedFile> {
        let file = File::open(path)?;
        // SAFETY: of `Mmap::map`: the file must not be modified while it is mapped. Caches of ours get their name by a rename
        // after the last write and are never opened for writing again under it; a new version is a new file. The mapping is
        // shared and read-only, so nothing is written through it. A foreign process of the same user that does write to it
        // is outside the threat model (`docs/formats/slot.md`), as it is for slots; what it could change are pixels, which
        // are read as plain bytes of which every value is valid.
        let map = unsafe { Mmap::map(&file)? };
        Ok(MappedFile { map })
    }
}

impl Deref for MappedFile {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.map
    }
}
