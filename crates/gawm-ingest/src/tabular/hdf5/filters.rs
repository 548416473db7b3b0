//! The filters of a chunk's pipeline.

use hdf5_reader::error::{Error, Result};
use hdf5_reader::filters::FilterRegistry;
use hdf5_reader::messages::filter_pipeline::FilterDescription;

use super::blosc;

/// Registered id of Blosc 1.
pub(crate) const BLOSC: u16 = 32001;

/// Filters that can be undone here.
const KNOWN: [(u16, &str); 8] = [
    (1, "deflate"),
    (2, "shuffle"),
    (3, "fletcher32"),
    (4, "szip"),
    (5, "nbit"),
    (6, "scaleoffset"),
    (32004, "lz4"),
    (BLOSC, "blosc"),
];

/// Filters that are often met and cannot be undone here.
const FOREIGN: [(u16, &str); 11] = [
    (305, "lzo"),
    (307, "bzip2"),
    (32000, "lzf"),
    (32008, "bitshuffle"),
    (32013, "zfp"),
    (32015, "zstd"),
    (32017, "sz"),
    (32019, "fcidecomp"),
    (32022, "bitgroom"),
    (32026, "blosc2"),
    (32028, "granular bitround"),
];

/// Returns the name of a filter id: ours, the file's, or `unknown`.
pub(crate) fn name(id: u16, in_file: Option<&str>) -> String {
    KNOWN
        .iter()
        .chain(&FOREIGN)
        .find(|(known, _)| *known == id)
        .map(|(_, name)| (*name).to_owned())
        .or_else(|| in_file.filter(|n| !n.is_empty()).map(ToOwned::to_owned))
        .unwrap_or_else(|| "unknown".to_owned())
}

/// Returns whether a filter can be undone.
pub(crate) fn is_known(id: u16) -> bool {
    // The library's LZ4 is behind a feature that is off, to keep its dependencies few; ours is here.
    KNOWN.iter().any(|(known, _)| *known == id)
}

/// Makes the registry: the library's filters, Blosc and LZ4, none decoding to more than `cap` bytes.
pub(crate) fn registry(cap: usize) -> FilterRegistry {
    let mut registry = FilterRegistry::new();
    let damaged = |e: String| Error::DecompressionError(e);
    registry.register(
        BLOSC,
        Box::new(move |_, data, _| blosc::decode(data, None, cap).map_err(|e| damaged(e.to_string()))),
    );
    registry.register(32004, Box::new(move |_, data, _| lz4(data, cap).map_err(damaged)));
    registry
}

/// Undoes the pipeline of one chunk, which must give `expected` bytes.
///
/// Bit `n` of `mask` says that filter `n` was skipped when the chunk was written.
pub(crate) fn undo(
    chunk: &[u8],
    filters: &[FilterDescription],
    mask: u32,
    item_bytes: usize,
    expected: usize,
    registry: &FilterRegistry,
) -> Result<Vec<u8>> {
    let mut data: Option<Vec<u8>> = None;
    for (i, filter) in filters.iter().enumerate().rev() {
        if mask & 1u32.checked_shl(i as u32).unwrap_or(0) != 0 {
            continue;
        }
        let input = data.as_deref().unwrap_or(chunk);
        // One byte more than expected shows a stream that is too long.
        let limit = expected.saturating_add(64 + expected / 8);
        let output = if filter.id == BLOSC {
            let demanded = filters[..i].is_empty().then_some(expected);
            blosc::decode(input, demanded, limit).map_err(|e| Error::DecompressionError(e.to_string()))?
        } else {
            registry.apply_with_limit(filter, input, item_bytes, Some(limit))?
        };
        data = Some(output);
    }
    let data = data.unwrap_or_else(|| chunk.to_vec());
    if data.len() != expected {
        return Err(Error::DecompressionError(format!("expected {expected} bytes, got {}", data.len())));
    }
    Ok(data)
}

/// HDF5's LZ4 layout: `u64` total and `u32` block bytes, big-endian, then `u32` length and data per block.
fn lz4(data: &[u8], cap: usize) -> std::result::Result<Vec<u8>, String> {
    let cut = || "lz4 chunk is cut".to_owned();
    let (total, rest) = data.split_first_chunk::<8>().ok_or_else(cut)?;
    let (block, mut rest) = rest.split_first_chunk::<4>().ok_or_else(cut)?;
    let total = usize::try_from(u64::from_be_bytes(*total)).ok().filter(|&t| t <= cap);
    let total = total.ok_or_else(|| format!("lz4 chunk: expected at most {cap} decoded bytes"))?;
    let block = u32::from_be_bytes(*block) as usize;
    if block == 0 && total > 0 {
        return Err("lz4 chunk: expected a block size above 0".to_owned());
    }
    let mut out = vec![0; total];
    for target in out.chunks_mut(block.max(1)) {
        let (length, after) = rest.split_first_chunk::<4>().ok_or_else(cut)?;
        let (stream, after) = after.split_at_checked(u32::from_be_bytes(*length) as usize).ok_or_else(cut)?;
        rest = after;
        if stream.len() == target.len() {
            target.copy_from_slice(stream);
        } else {
            let got = lz4_flex::block::decompress_into(stream, target).map_err(|e| e.to_string())?;
            if got != target.len() {
                return Err(format!("lz4 block: expected {} bytes, got {got}", target.len()));
            }
        }
    }
    Ok(out)
}
