//! Blosc 1 frames (HDF5 filter 32001), decoded block by block.
//!
//! ```text
//! 0  u8 version (1 or 2)   1  u8 codec version   2  u8 flags      3  u8 element size
//! 4  u32 decoded bytes     8  u32 block bytes    12 u32 frame bytes
//! 16 u32 per block: where it starts in the frame; or the data themselves if flag 0x02
//! ```
//! Flags: 0x01 byte shuffle, 0x02 stored, 0x04 bit shuffle, 0x10 blocks are not split, bits 5-7 codec.
//! A block is one stream, or one per byte of an element: `i32` length, then that many bytes.
//! A row of an image column touches few blocks, so a row costs a few blocks and not its whole chunk.

use std::borrow::Cow;
use std::ops::Range;

use super::blosclz;

/// Bytes before the table of blocks.
pub(crate) const HEADER_BYTES: usize = 16;

/// A block is split only into at most this many streams (c-blosc `MAX_SPLITS`).
const MAX_SPLITS: usize = 16;
/// A block is split only into streams of at least this size (c-blosc `MIN_BUFFERSIZE`).
const MIN_STREAM_BYTES: usize = 128;

/// Why a frame cannot be decoded.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum BloscError {
    /// Fewer bytes than the format needs.
    #[error("blosc frame too short: expected {expected} bytes, got {got}")]
    Short { expected: u64, got: u64 },
    /// Not Blosc 1.
    #[error("blosc frame of version {got}: expected 1 or 2")]
    Version { got: u8 },
    /// The frame does not decode to what the chunk must hold.
    #[error("blosc frame decodes to {got} bytes: expected {expected}")]
    Size { expected: u64, got: u64 },
    /// A header field that no writer makes.
    #[error("blosc header field {field} is {got}: expected {expected}")]
    Header { field: &'static str, got: u64, expected: String },
    /// A codec that is not built in.
    #[error("blosc codec {name}: expected blosclz, lz4, zlib or zstd")]
    Codec { name: String },
    /// A block does not decode.
    #[error("blosc block {block}: {detail}")]
    Block { block: usize, detail: String },
    /// The bytes cannot be read.
    #[error("{0}")]
    Read(String),
}

/// Where the bytes of a frame come from.
pub(crate) trait FrameBytes {
    /// Returns `len` bytes from offset `at` of the frame.
    fn read(&self, at: usize, len: usize) -> Result<Cow<'_, [u8]>, BloscError>;
    /// Returns how many bytes the frame has.
    fn len(&self) -> usize;
}

impl FrameBytes for &[u8] {
    fn read(&self, at: usize, len: usize) -> Result<Cow<'_, [u8]>, BloscError> {
        let end = at.checked_add(len).filter(|&end| end <= (**self).len());
        match end {
            Some(end) => Ok(Cow::Borrowed(&self[at..end])),
            None => Err(BloscError::Short {
                expected: (at as u64).saturating_add(len as u64),
                got: (**self).len() as u64,
            }),
        }
    }

    fn len(&self) -> usize {
        (**self).len()
    }
}

/// A frame's header and its table of blocks.
#[derive(Debug, Clone)]
pub(crate) struct Frame {
    flags: u8,
    type_bytes: usize,
    /// Bytes after decoding.
    pub(crate) n_bytes: usize,
    block_bytes: usize,
    frame_bytes: usize,
    /// Where each block's streams lie in the frame; empty for a stored frame.
    blocks: Vec<Range<usize>>,
}

impl Frame {
    /// Parses header and table; demands `expected` decoded bytes when given, and never more than `cap`.
    pub(crate) fn parse(
        bytes: &impl FrameBytes,
        expected: Option<usize>,
        cap: usize,
    ) -> Result<Self, BloscError> {
        let header = bytes.read(0, HEADER_BYTES)?;
        let word = |at: usize| {
            u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]) as usize
        };
        if !matches!(header[0], 1 | 2) {
            return Err(BloscError::Version { got: header[0] });
        }
        let (n_bytes, block_bytes, frame_bytes) = (word(4), word(8), word(12));
        let limit = expected.unwrap_or(cap);
        if expected.is_some_and(|e| e != n_bytes) || n_bytes > cap {
            return Err(BloscError::Size { expected: limit as u64, got: n_bytes as u64 });
        }
        if frame_bytes < HEADER_BYTES || frame_bytes > bytes.len() {
            return Err(BloscError::Short {
                expected: frame_bytes.max(HEADER_BYTES) as u64,
                got: bytes.len() as u64,
            });
        }
        let mut frame = Self {
            flags: header[2],
            type_bytes: usize::from(header[3]).max(1),
            n_bytes,
            block_bytes,
            frame_bytes,
            blocks: Vec::new(),
        };
        frame.check_header()?;
        if !frame.is_stored() && n_bytes > 0 {
            frame.blocks = frame.block_table(bytes)?;
        }
        Ok(frame)
    }

    fn is_stored(&self) -> bool {
        self.flags & 0x02 != 0
    }

    fn check_header(&self) -> Result<(), BloscError> {
        if self.is_stored() {
            let expected = HEADER_BYTES as u64 + self.n_bytes as u64;
            if (self.frame_bytes as u64) < expected {
                return Err(BloscError::Short { expected, got: self.frame_bytes as u64 });
            }
            return Ok(());
        }
        // A block larger than the data would only cost memory; writers clip it.
        if self.n_bytes > 0 && (self.block_bytes == 0 || self.block_bytes > self.n_bytes) {
            let expected = format!("1..={}", self.n_bytes);
            return Err(BloscError::Header { field: "block bytes", got: self.block_bytes as u64, expected });
        }
        Ok(())
    }

    fn block_table(&self, bytes: &impl FrameBytes) -> Result<Vec<Range<usize>>, BloscError> {
        let n_blocks = self.n_bytes.div_ceil(self.block_bytes);
        let table_bytes = n_blocks.saturating_mul(4);
        let data_start = table_bytes.saturating_add(HEADER_BYTES);
        if data_start > self.frame_bytes {
            return Err(BloscError::Short { expected: data_start as u64, got: self.frame_bytes as u64 });
        }
        let table = bytes.read(HEADER_BYTES, table_bytes)?;
        let starts: Vec<usize> =
            table.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]]) as usize).collect();
        if let Some(&got) = starts.iter().find(|&&s| s < data_start || s >= self.frame_bytes) {
            let expected = format!("{data_start}..{}", self.frame_bytes);
            return Err(BloscError::Header { field: "block start", got: got as u64, expected });
        }
        // Threads write blocks in any order: a block ends where the next one in the frame starts.
        let mut sorted = starts.clone();
        sorted.sort_unstable();
        Ok(starts
            .iter()
            .map(|&start| {
                let next = sorted.partition_point(|&s| s <= start);
                start..sorted.get(next).copied().unwrap_or(self.frame_bytes)
            })
            .collect())
    }

    /// Decodes bytes `range` of the data and appends them to `out`.
    pub(crate) fn decode_range(
        &self,
        bytes: &impl FrameBytes,
        range: Range<usize>,
        out: &mut Vec<u8>,
    ) -> Result<(), BloscError> {
        if range.start > range.end || range.end > self.n_bytes {
            return Err(BloscError::Short { expected: range.end as u64, got: self.n_bytes as u64 });
        }
        if range.is_empty() {
            return Ok(());
        }
        if self.is_stored() {
            out.extend_from_slice(&bytes.read(HEADER_BYTES + range.start, range.len())?);
            return Ok(());
        }
        let (mut streams, mut block) = (Vec::new(), Vec::new());
        for i in range.start / self.block_bytes..range.end.div_ceil(self.block_bytes) {
            let start = i * self.block_bytes;
            let size = self.block_bytes.min(self.n_bytes - start);
            let encoded = bytes.read(self.blocks[i].start, self.blocks[i].len())?;
            self.decode_block(i, &encoded, size, &mut streams)?;
            let decoded = self.unshuffle(&streams, &mut block);
            out.extend_from_slice(
                &decoded[range.start.max(start) - start..range.end.min(start + size) - start],
            );
        }
        Ok(())
    }

    fn decode_block(
        &self,
        i: usize,
        mut encoded: &[u8],
        size: usize,
        out: &mut Vec<u8>,
    ) -> Result<(), BloscError> {
        let fail = |detail: String| BloscError::Block { block: i, detail };
        let is_split = self.flags & 0x10 == 0
            && self.type_bytes <= MAX_SPLITS
            && self.block_bytes / self.type_bytes >= MIN_STREAM_BYTES
            && size == self.block_bytes;
        let n_streams = if is_split { self.type_bytes } else { 1 };
        let stream_bytes = size / n_streams;
        if stream_bytes * n_streams != size {
            return Err(fail(format!("expected a size divisible by {n_streams}, got {size}")));
        }
        out.clear();
        out.resize(size, 0);
        for target in out.chunks_exact_mut(stream_bytes) {
            let Some((length, rest)) = encoded.split_first_chunk::<4>() else {
                return Err(fail(format!("expected 4 bytes of length, got {}", encoded.len())));
            };
            let length = u32::from_le_bytes(*length) as usize;
            let Some((stream, rest)) = rest.split_at_checked(length) else {
                return Err(fail(format!("expected a stream of {length} bytes, got {}", rest.len())));
            };
            encoded = rest;
            if length == stream_bytes {
                target.copy_from_slice(stream);
            } else {
                self.decode_stream(stream, target).map_err(|e| match e {
                    StreamError::Codec(name) => BloscError::Codec { name },
                    StreamError::Damaged(detail) => fail(detail),
                })?;
            }
        }
        Ok(())
    }

    fn decode_stream(&self, stream: &[u8], target: &mut [u8]) -> Result<(), StreamError> {
        let damaged = |e: String| StreamError::Damaged(e);
        let got = match self.flags >> 5 {
            0 => blosclz::decompress(stream, target).map_err(|e| damaged(e.to_owned()))?,
            1 => lz4_flex::block::decompress_into(stream, target).map_err(|e| damaged(e.to_string()))?,
            2 => return Err(StreamError::Codec("snappy".to_owned())),
            3 => inflate(stream, target).map_err(damaged)?,
            4 => zstd::bulk::decompress_to_buffer(stream, target).map_err(|e| damaged(e.to_string()))?,
            id => return Err(StreamError::Codec(format!("number {id}"))),
        };
        if got != target.len() {
            return Err(damaged(format!("expected {} decoded bytes, got {got}", target.len())));
        }
        Ok(())
    }

    fn unshuffle<'a>(&self, block: &'a [u8], out: &'a mut Vec<u8>) -> &'a [u8] {
        let size = self.type_bytes;
        if self.flags & 0x01 != 0 && size > 1 {
            out.clear();
            out.resize(block.len(), 0);
            unshuffle_bytes(block, size, out);
            out
        } else if self.flags & 0x04 != 0 && block.len() >= size {
            out.clear();
            out.resize(block.len(), 0);
            unshuffle_bits(block, size, out);
            out
        } else {
            block
        }
    }
}

enum StreamError {
    Codec(String),
    Damaged(String),
}

fn inflate(stream: &[u8], target: &mut [u8]) -> Result<usize, String> {
    let mut inflate = flate2::Decompress::new(true);
    match inflate.decompress(stream, target, flate2::FlushDecompress::Finish) {
        Ok(flate2::Status::StreamEnd) => usize::try_from(inflate.total_out()).map_err(|e| e.to_string()),
        Ok(status) => Err(format!("expected the end of the zlib stream, got {status:?}")),
        Err(e) => Err(e.to_string()),
    }
}

/// Undoes the byte shuffle: byte `b` of element `i` lies at `b * n + i`; what is left over stays in place.
fn unshuffle_bytes(block: &[u8], size: usize, out: &mut [u8]) {
    let n = block.len() / size;
    for (b, plane) in block[..n * size].chunks_exact(n.max(1)).enumerate() {
        for (i, &byte) in plane.iter().enumerate() {
            out[i * size + b] = byte;
        }
    }
    out[n * size..].copy_from_slice(&block[n * size..]);
}

/// Undoes the bit shuffle: bit `k` of byte `b` of elements `8j..8j+8` are the bits of one byte of row `8b + k`.
///
/// A block whose element count is no multiple of 8 was copied as it is (c-blosc `bitshuffle`).
fn unshuffle_bits(block: &[u8], size: usize, out: &mut [u8]) {
    let n = block.len() / size;
    if !n.is_multiple_of(8) {
        out.copy_from_slice(block);
        return;
    }
    let row_bytes = n / 8;
    for b in 0..size {
        for k in 0..8 {
            let row = &block[(b * 8 + k) * row_bytes..][..row_bytes];
            for (j, &bits) in row.iter().enumerate() {
                for i in 0..8 {
                    out[(8 * j + i) * size + b] |= ((bits >> i) & 1) << k;
                }
            }
        }
    }
    out[n * size..].copy_from_slice(&block[n * size..]);
}

/// Decodes a whole frame that is in memory.
pub(crate) fn decode(frame: &[u8], expected: Option<usize>, cap: usize) -> Result<Vec<u8>, BloscError> {
    let parsed = Frame::parse(&frame, expected, cap)?;
    // The blocks' decoders check every byte, so a lying header costs at most one block here.
    let mut out = Vec::with_capacity(parsed.n_bytes.min(frame.len().saturating_mul(8)));
    parsed.decode_range(&frame, 0..parsed.n_bytes, &mut out)?;
    Ok(out)
}
