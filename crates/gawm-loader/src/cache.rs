//! All frames decoded, in one file that every loader maps.
//!
//! ```text
//! bytes       type    field
//!   0..  8    [u8]    magic "GAWMCACH"
//!   8.. 12    u32     version, 1
//!  12.. 16    u32     zero
//!  16.. 48    [u8]    key: hash over the content hashes of the datasets, the cameras and the size
//!  48.. 56    u64     number of frames
//!  56.. 64    u64     bytes of a frame
//!  64.. 96    [u8]    BLAKE3 of all frames
//!  96..128    [u8]    BLAKE3 of bytes 0..96
//! 4096..      u8      frames [row, V, H, W, C], dataset after dataset
//! ```
//!
//! The file is written under another name and renamed when it is whole and on the disk, so a cache that has its name is
//! complete; one writer works at a time (`flock`), the others wait and then map what it made. The hash of the frames is
//! checked on demand only: it costs a pass over the file.

use std::fs::{self, File, OpenOptions};
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use gawm_schema::ContentHash;
use gawm_shm::MappedFile;
use rayon::prelude::*;
use rustix::fs::{FlockOperation, flock};
use serde_json::json;

use crate::error::LoadError;
use crate::index::Index;
use crate::maker::read_frame;

const MAGIC: [u8; 8] = *b"GAWMCACH";
const VERSION: u32 = 1;
const HEAD_BYTES: usize = 128;
const CHECKED_BYTES: usize = 96;
/// Frames begin at a page.
const DATA_OFFSET: u64 = 4096;
/// Frames that are decoded before they are written.
const BLOCK_FRAMES: usize = 256;
/// Time between two looks whether another loader has finished the file.
const WAIT: Duration = Duration::from_millis(50);

/// What a cache would be.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CachePlan {
    /// The file.
    pub path: PathBuf,
    /// Its frames.
    pub frames: u64,
    /// Bytes of a frame.
    pub frame_bytes: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Whether the file is there.
    pub exists: bool,
    key: ContentHash,
    /// First frame of each dataset.
    first: Vec<u64>,
}

/// A cache, mapped.
#[derive(Debug)]
pub struct Cache {
    file: MappedFile,
    first: Vec<u64>,
    views: u64,
    frame_bytes: usize,
}

impl CachePlan {
    /// Returns the cache of an index: its name, its size, whether it is there.
    pub fn of(index: &Index) -> CachePlan {
        let shape = index.layout().shape();
        let cameras: Vec<&str> = index.cameras().iter().map(|c| c.name.as_str()).collect();
        let datasets: Vec<String> = index.sources.iter().map(|s| s.content_hash.to_string()).collect();
        let key = ContentHash::of_json(&json!({
            "format": "gawm cache",
            "version": VERSION,
            "datasets": datasets,
            "cameras": cameras,
            "size": [shape.height, shape.width, shape.channels],
        }));
        let mut first = Vec::new();
        let mut frames = 0;
        for source in &index.sources {
            first.push(frames);
            frames += source.n_rows() * shape.views as u64;
        }
        let folder = match &index.config.cache_dir {
            Some(folder) => folder.clone(),
            None => index.sources[0].path.join("gawm").join("cache"),
        };
        let path = folder.join(format!("frames-{}.bin", &key.to_string()[..16]));
        let frame_bytes = shape.frame_bytes() as u64;
        let bytes = DATA_OFFSET.saturating_add(frames.saturating_mul(frame_bytes));
        CachePlan { exists: path.is_file(), path, frames, frame_bytes, bytes, key, first }
    }

    /// Refuses a cache above the budget.
    ///
    /// # Errors
    /// [`LoadError::CacheBudget`]
    pub fn check_budget(&self, budget_gib: f64) -> Result<(), LoadError> {
        let budget = (budget_gib * (1_u64 << 30) as f64) as u64;
        if self.bytes > budget {
            return Err(LoadError::CacheBudget { budget, needed: self.bytes });
        }
        Ok(())
    }

    /// Maps the cache; makes it first where it is not there, or waits for another process that does.
    ///
    /// `progress` is told the frames that are decoded.
    ///
    /// # Errors
    /// - [`LoadError::Cache`] if the file is of another version, for other data, or too short
    /// - [`LoadError::Interrupted`] if `stop` was set
    /// - [`LoadError::Frame`], [`LoadError::Page`] if a frame cannot be decoded
    /// - [`LoadError::Io`] if it cannot be written, say because the disk is full
    pub fn open_or_make(
        &self,
        index: &Index,
        stop: &AtomicBool,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<Cache, LoadError> {
        if !self.path.is_file() {
            let folder = self.path.parent().unwrap_or(Path::new("."));
            fs::create_dir_all(folder).map_err(LoadError::io("create", folder))?;
            let lock = self.lock(stop)?;
            if !self.path.is_file() {
                self.make(index, stop, progress)?;
            }
            drop(lock);
        }
        self.map(index.layout().shape().views as u64)
    }

    /// Takes the right to write the file; released when the process ends, however it ends.
    fn lock(&self, stop: &AtomicBool) -> Result<File, LoadError> {
        let path = self.path.with_extension("lock");
        let open = OpenOptions::new().create(true).truncate(false).write(true).open(&path);
        let file = open.map_err(LoadError::io("open", &path))?;
        loop {
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => return Ok(file),
                Err(rustix::io::Errno::WOULDBLOCK) => std::thread::sleep(WAIT),
                Err(error) => return Err(LoadError::io("lock", &path)(error.into())),
            }
            if stop.load(Ordering::Relaxed) {
                return Err(LoadError::Interrupted);
            }
        }
    }

    fn make(
        &self,
        index: &Index,
        stop: &AtomicBool,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<(), LoadError> {
        let unfinished = self.path.with_extension("tmp");
        let made = self.write(&unfinished, index, stop, progress);
        if made.is_err() {
            // What is left of it is of no use; if it cannot be removed, the next attempt writes over it.
            fs::remove_file(&unfinished).ok();
        }
        made?;
        fs::rename(&unfinished, &self.path).map_err(LoadError::io("rename", &self.path))
    }

    fn write(
        &self,
        path: &Path,
        index: &Index,
        stop: &AtomicBool,
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<(), LoadError> {
        let failed = || LoadError::io("write", path);
        let file = File::create(path).map_err(LoadError::io("create", path))?;
        // The room is taken at once: a full disk shows now and not after an hour.
        match rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, self.bytes) {
            Ok(()) | Err(rustix::io::Errno::OPNOTSUPP) => {}
            Err(error) => return Err(failed()(error.into())),
        }
        let mut writer = BufWriter::new(file);
        writer.seek(SeekFrom::Start(DATA_OFFSET)).map_err(failed())?;
        let mut hasher = blake3::Hasher::new();
        let views = index.layout().shape().views;
        let frame_bytes = self.frame_bytes as usize;
        let mut block = vec![0; BLOCK_FRAMES * frame_bytes];
        for (dataset, source) in index.sources.iter().enumerate() {
            let frames = source.n_rows() * views as u64;
            let mut at = 0;
            while at < frames {
                if stop.load(Ordering::Relaxed) {
                    return Err(LoadError::Interrupted);
                }
                let n = (frames - at).min(BLOCK_FRAMES as u64) as usize;
                let block = &mut block[..n * frame_bytes];
                block.par_chunks_exact_mut(frame_bytes).enumerate().try_for_each_init(
                    Vec::new,
                    |page, (i, out)| {
                        let frame = at + i as u64;
                        let (row, view) = (frame / views as u64, (frame % views as u64) as usize);
                        read_frame(index, dataset, row, view, page, out)
                    },
                )?;
                hasher.update(block);
                writer.write_all(block).map_err(failed())?;
                at += n as u64;
                progress(n as u64);
            }
        }
        writer.seek(SeekFrom::Start(0)).map_err(failed())?;
        writer.write_all(&self.head(ContentHash(*hasher.finalize().as_bytes()))).map_err(failed())?;
        let file = writer.into_inner().map_err(|e| failed()(e.into_error()))?;
        file.set_len(self.bytes).map_err(failed())?;
        file.sync_all().map_err(failed())
    }

    fn head(&self, content: ContentHash) -> Vec<u8> {
        let mut head = MAGIC.to_vec();
        head.extend(VERSION.to_le_bytes());
        head.extend(0_u32.to_le_bytes());
        head.extend(self.key.0);
        head.extend(self.frames.to_le_bytes());
        head.extend(self.frame_bytes.to_le_bytes());
        head.extend(content.0);
        let checksum = ContentHash::of(&head);
        head.extend(checksum.0);
        head
    }

    fn map(&self, views: u64) -> Result<Cache, LoadError> {
        let file = MappedFile::open(&self.path).map_err(LoadError::io("map", &self.path))?;
        let wrong = |expected: &str, got: String| LoadError::Cache {
            path: self.path.clone(),
            expected: expected.to_owned(),
            got,
        };
        if file.len() as u64 != self.bytes {
            return Err(wrong(&format!("{} bytes", self.bytes), file.len().to_string()));
        }
        let head = &file[..HEAD_BYTES];
        let mut content = [0; 32];
        content.copy_from_slice(&head[64..CHECKED_BYTES]);
        if head != self.head(ContentHash(content)) {
            return Err(wrong(
                "a header of version 1 for these datasets, cameras and size",
                "another".to_owned(),
            ));
        }
        let (first, frame_bytes) = (self.first.clone(), self.frame_bytes as usize);
        Ok(Cache { file, first, views, frame_bytes })
    }
}

impl Cache {
    /// Returns the pixels of a frame.
    pub(crate) fn frame(&self, dataset: usize, row: u64, view: usize) -> &[u8] {
        let frame = self.first[dataset] + row * self.views + view as u64;
        let start = DATA_OFFSET as usize + frame as usize * self.frame_bytes;
        &self.file[start..start + self.frame_bytes]
    }

    /// Reads the whole file and returns whether its frames have the hash that was written with them.
    pub fn is_intact(&self) -> bool {
        ContentHash::of(&self.file[DATA_OFFSET as usize..]).0 == self.file[64..CHECKED_BYTES]
    }
}
