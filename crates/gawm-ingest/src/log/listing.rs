//! Hands out every record of a file in its order, chunks opened.

use std::fs::File;
use std::path::Path;

use super::OpenOptions;
use super::block::{BlockRef, check_chunk, unpack_chunk};
use super::damage::{Damage, DamageKind};
use super::error::OpenLogError;
use super::open::{check_magic, limits};
use super::source::{Source, Window};
use super::step::{Item, classify};
use super::walk::chunk_block;
use super::wire::{MAGIC, RECORD_PREFIX, RawRecord, Records};

/// A file whose records are listed one after the other.
#[derive(Debug)]
pub(crate) struct RecordSource {
    source: Source,
    options: OpenOptions,
    damage: Vec<Damage>,
}

impl RecordSource {
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self, OpenLogError> {
        let source = Source::open(path)?;
        let mut damage = Vec::new();
        check_magic(path, &source, limits(options), &mut damage)?;
        Ok(Self { source, options: options.clone(), damage })
    }

    /// Calls `take` with every record up to the footer or the first place that is no record; returns the damage met.
    pub(crate) fn for_each(mut self, take: &mut dyn FnMut(RawRecord<'_>)) -> Vec<Damage> {
        let mut window = Window::new(&self.source);
        let mut at = MAGIC.len() as u64;
        let limits = limits(&self.options);
        while at < self.source.len() {
            let step = match classify(&mut window, at, self.source.len(), limits) {
                Ok(Ok(step)) => step,
                Ok(Err(_)) => {
                    let detail = "no whole record starts here; `inspect` without `--records` reads past it";
                    self.damage.push(Damage::new(DamageKind::RecordMalformed, at, detail));
                    break;
                }
                Err(error) => {
                    self.damage.push(Damage::new(DamageKind::ReadFailed, at, error.to_string()));
                    break;
                }
            };
            match &step.item {
                Item::Chunk(header) => {
                    let block = chunk_block(header, at, step.next - at);
                    open_chunk(&self.source, &block, limits, &mut self.damage, take);
                }
                _ => match read_body(&self.source, at, step.next, limits.record_bytes) {
                    Ok(body) => take(RawRecord { op: step.op, at: 0, body: &body }),
                    Err(damage) => self.damage.push(damage),
                },
            }
            if matches!(step.item, Item::Footer) {
                break;
            }
            at = step.next;
        }
        self.damage
    }
}

fn open_chunk(
    source: &Source,
    block: &BlockRef,
    limits: super::block::Limits,
    damage: &mut Vec<Damage>,
    take: &mut dyn FnMut(RawRecord<'_>),
) {
    let mut found = Vec::new();
    match unpack_chunk(source, block, limits, &mut found) {
        Ok(chunk) => match check_chunk(&chunk, block.offset, &mut found) {
            Ok(()) => Records::new(&chunk.data).for_each(take),
            Err(mismatch) => found.push(mismatch),
        },
        Err(failure) => found.push(failure),
    }
    damage.append(&mut found);
}

fn read_body(source: &Source, at: u64, next: u64, limit: u64) -> Result<bytes::Bytes, Damage> {
    let length = next - at - RECORD_PREFIX;
    let too_large = || {
        Damage::new(
            DamageKind::SizeLimit,
            at,
            format!("the record has {length} bytes, expected at most {limit}"),
        )
    };
    let n = Some(length)
        .filter(|&length| length <= limit)
        .and_then(|length| usize::try_from(length).ok())
        .ok_or_else(too_large)?;
    source
        .read(at + RECORD_PREFIX, n)
        .map_err(|error| Damage::new(DamageKind::ReadFailed, at, error.to_string()))
}

impl Source {
    /// Opens a file.
    pub(crate) fn open(path: &Path) -> Result<Self, OpenLogError> {
        let io_error = |source| OpenLogError::Io { path: path.to_owned(), source };
        let about = std::fs::metadata(path).map_err(io_error)?;
        if !about.is_file() {
            return Err(OpenLogError::NotAFile { path: path.to_owned() });
        }
        Ok(Self::File { file: File::open(path).map_err(io_error)?, length: about.len() })
    }
}
