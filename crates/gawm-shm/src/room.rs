//! Room for slots: counted before anything is created, then taken for good.

use std::fs::OpenOptions;
use std::path::Path;

use rustix::fs::{FallocateFlags, fallocate, statvfs};
use rustix::io::Errno;

use crate::domain::{Domain, shm_files};
use crate::error::ShmError;
use crate::place::SHM;

/// What iceoryx2 needs beside the slots: states, queues, headers.
const OVERHEAD_BYTES: u64 = 1 << 20;

/// Returns the bytes that so many slots need.
pub(crate) fn needed(slots: usize, slot_bytes: usize) -> u64 {
    (slots as u64).saturating_mul(slot_bytes as u64 + 4096).saturating_add(OVERHEAD_BYTES)
}

/// Returns the free bytes of shared memory.
fn available() -> Result<u64, ShmError> {
    let shm = Path::new(SHM);
    let stat = statvfs(shm).map_err(|e| ShmError::io("ask for the room in", shm)(e.into()))?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Checks that the slots fit.
pub(crate) fn check(slots: usize, slot_bytes: usize) -> Result<(), ShmError> {
    let (needed, available) = (needed(slots, slot_bytes), available()?);
    if needed > available {
        return Err(ShmError::NoRoom { needed, available, slots, path: SHM.into() });
    }
    Ok(())
}

/// Makes the file system provide every page of the domain's files.
///
/// Without it a file has holes, and the first write to a hole of a full file system kills the process (SIGBUS). Another
/// process may have taken the room since [`check`]: then this is where it shows.
pub(crate) fn reserve(domain: &Domain, slots: usize, slot_bytes: usize) -> Result<(), ShmError> {
    for (path, length) in shm_files(|file| file.starts_with(domain.prefix()))? {
        if length == 0 {
            continue;
        }
        let file = OpenOptions::new().write(true).open(&path).map_err(ShmError::io("open", &path))?;
        match fallocate(&file, FallocateFlags::empty(), 0, length) {
            Ok(()) => {}
            Err(Errno::NOSPC) => {
                let (needed, available) = (needed(slots, slot_bytes), available()?);
                return Err(ShmError::NoRoom { needed, available, slots, path: SHM.into() });
            }
            Err(error) => return Err(ShmError::io("reserve room for", &path)(error.into())),
        }
    }
    Ok(())
}
