//! Chunk and message-body decompression under a cap, and what can be salvaged of a damaged stream.

use std::cell::RefCell;
use std::io::{self, Read};

use super::error::ReadError;

/// Below this size a chunk is never taken for a decompression bomb.
const BOMB_FLOOR_BYTES: u64 = 256 << 20;
/// Above the floor, a stated ratio of more than this is refused: real logs stay below 100.
const BOMB_RATIO: u64 = 1000;
/// How many bytes salvage reads at once.
const SALVAGE_STEP: usize = 64 << 10;

/// The compressions of MCAP chunks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Compression {
    None,
    Zstd,
    Lz4,
}

impl Compression {
    pub(crate) fn from_name(name: &str) -> Option<Self> {
        match name {
            "" | "none" => Some(Self::None),
            "zstd" => Some(Self::Zstd),
            "lz4" => Some(Self::Lz4),
            _ => None,
        }
    }
}

/// What came out of a compressed stream.
#[derive(Debug)]
pub(crate) struct Decompressed {
    pub(crate) data: Vec<u8>,
    /// Why `data` is not the whole stream, if it is not.
    pub(crate) failure: Option<String>,
}

/// Says why a stated size must not be allocated, if it must not.
pub(crate) fn size_refusal(stored: u64, uncompressed: u64, limit: u64) -> Option<String> {
    if uncompressed > limit {
        return Some(format!("states {uncompressed} uncompressed bytes, expected at most {limit}"));
    }
    let is_bomb = uncompressed > BOMB_FLOOR_BYTES && uncompressed / BOMB_RATIO > stored;
    is_bomb.then(|| format!("states {uncompressed} uncompressed bytes of {stored} stored ones, expected a ratio of at most {BOMB_RATIO}"))
}

thread_local! {
    static ZSTD: RefCell<Option<zstd::bulk::Decompressor<'static>>> = const { RefCell::new(None) };
}

/// Decompresses a chunk whose stated size has passed [`size_refusal`]; never yields more than that size.
pub(crate) fn decompress(compression: Compression, stored: &[u8], uncompressed: usize) -> Decompressed {
    let whole = match compression {
        Compression::None => Ok(stored.to_vec()),
        Compression::Zstd => zstd_whole(stored, uncompressed),
        Compression::Lz4 => lz4_whole(stored, uncompressed),
    };
    match whole {
        Ok(data) => Decompressed { data, failure: None },
        Err(error) => salvage(compression, stored, uncompressed, error.to_string()),
    }
}

fn zstd_whole(stored: &[u8], uncompressed: usize) -> io::Result<Vec<u8>> {
    ZSTD.with_borrow_mut(|slot| {
        let decompressor = match slot {
            Some(decompressor) => decompressor,
            None => slot.insert(zstd::bulk::Decompressor::new()?),
        };
        let mut data = Vec::with_capacity(uncompressed);
        decompressor.decompress_to_buffer(stored, &mut data)?;
        Ok(data)
    })
}

fn lz4_whole(stored: &[u8], uncompressed: usize) -> io::Result<Vec<u8>> {
    let mut data = Vec::with_capacity(uncompressed);
    let mut decoder = lz4_flex::frame::FrameDecoder::new(stored).take(uncompressed as u64);
    decoder.read_to_end(&mut data)?;
    let mut after_the_end = [0];
    if decoder.into_inner().read(&mut after_the_end)? != 0 {
        return Err(io::Error::other("more bytes come out than the chunk states"));
    }
    Ok(data)
}

/// Decompresses as far as the stream is good.
pub(crate) fn salvage(
    compression: Compression,
    stored: &[u8],
    uncompressed: usize,
    failure: String,
) -> Decompressed {
    let data = match compression {
        Compression::None => stored[..stored.len().min(uncompressed)].to_vec(),
        Compression::Zstd => zstd::stream::read::Decoder::with_buffer(stored)
            .map_or_else(|_| Vec::new(), |decoder| read_prefix(decoder, uncompressed)),
        Compression::Lz4 => read_prefix(lz4_flex::frame::FrameDecoder::new(stored), uncompressed),
    };
    Decompressed { data, failure: Some(failure) }
}

/// Reads until the first error, keeping what came before it.
fn read_prefix(mut reader: impl Read, limit: usize) -> Vec<u8> {
    let mut data = Vec::new();
    while data.len() < limit {
        let from = data.len();
        data.resize(from + SALVAGE_STEP.min(limit - from), 0);
        let n_read = reader.read(&mut data[from..]).unwrap_or(0);
        data.truncate(from + n_read);
        if n_read == 0 {
            break;
        }
    }
    data
}

/// Returns whether a message body starts like a zstd frame, as rosbag2 writes it in compression mode `MESSAGE`.
pub fn looks_like_zstd(payload: &[u8]) -> bool {
    payload.starts_with(&[0x28, 0xb5, 0x2f, 0xfd])
}

/// Decompresses one zstd message body into at most `limit` bytes.
///
/// # Errors
/// - [`ReadError::TooLarge`]: the frame states or yields more than `limit` bytes.
/// - [`ReadError::Decompress`]: it is no whole zstd frame.
pub fn decompress_message(payload: &[u8], limit: u64) -> Result<Vec<u8>, ReadError> {
    let bad = |reason: String| ReadError::Decompress { reason };
    let too_large = |size| ReadError::TooLarge { what: "message body", size, limit };
    let stated = zstd::zstd_safe::get_frame_content_size(payload).ok().flatten();
    if let Some(size) = stated.filter(|&size| size > limit) {
        return Err(too_large(size));
    }
    if let Some(refusal) = stated.and_then(|size| size_refusal(payload.len() as u64, size, limit)) {
        return Err(bad(refusal));
    }
    let mut data = Vec::new();
    let decoder =
        zstd::stream::read::Decoder::with_buffer(payload).map_err(|error| bad(error.to_string()))?;
    decoder.take(limit.saturating_add(1)).read_to_end(&mut data).map_err(|error| bad(error.to_string()))?;
    if data.len() as u64 > limit {
        return Err(too_large(data.len() as u64));
    }
    Ok(data)
}
