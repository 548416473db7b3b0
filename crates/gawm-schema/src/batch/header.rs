//! The first bytes of a slot.

use super::{BatchError, BatchId, BatchLayout, BatchShape, Section, Split};
use crate::ContentHash;

/// The first eight bytes of every slot that holds a batch.
pub const SLOT_MAGIC: [u8; 8] = *b"GAWMSLOT";
/// Version of the format that `docs/formats/slot.md` describes.
pub const SLOT_VERSION: u32 = 1;
/// Length of the header in bytes; sections begin behind it.
pub const SLOT_HEADER_BYTES: usize = 320;

/// What a slot says about itself; all numbers are little-endian.
///
/// ```text
/// bytes       type    field
///   0.. 8     [u8]    magic "GAWMSLOT"
///   8.. 12    u32     version, 1
///  12.. 16    u32     header length, 320
///  16.. 48    [u8]    layout hash
///  48.. 80    [u8]    schema hash of the dataset
///  80..112    [u8]    stream hash: everything that decides the content of the n-th batch
/// 112..120    u64     n: position in the sequence
/// 120..128    u64     epoch
/// 128..136    u64     step
/// 136..140    u32     split: 0 train, 1 validation
/// 140..144    u32     loader that made it
/// 144..148    u32     number of loaders
/// 148..152    u32     rank it is for
/// 152..156    u32     number of ranks
/// 156..160    u32     clips in this batch, at most B
/// 160..192    u32[8]  B, T, V, H, W, C, A, S
/// 192..248    u64[7]  offsets of clip ids, frames, actions, states, action mask, state mask, frame mask
/// 248..256    u64     bytes of the slot
/// 256..288    [u8]    zero
/// 288..320    [u8]    BLAKE3 of bytes 0..288
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotHeader {
    /// Hash of the schema of the dataset, [`Hello::schema_hash`](super::Hello::schema_hash).
    pub schema_hash: ContentHash,
    /// Hash over everything that decides the content of a batch, [`Hello::stream_hash`](super::Hello::stream_hash).
    pub stream_hash: ContentHash,
    /// Position in the [`Sequence`](super::Sequence).
    pub n: u64,
    /// Which batch that is.
    pub batch: BatchId,
    /// The loader that made it.
    pub loader: u32,
    /// Number of loaders.
    pub loaders: u32,
    /// The rank it is for.
    pub rank: u32,
    /// Number of ranks.
    pub ranks: u32,
    /// Clips in this batch: B, or fewer in the last batch of a small validation set.
    pub clips: usize,
}

/// Where the checksum begins.
const CHECKED_BYTES: usize = 288;

impl SlotHeader {
    /// Writes the header to the first bytes of a slot.
    ///
    /// # Panics
    /// If the slot is shorter than [`SLOT_HEADER_BYTES`].
    pub fn write(&self, layout: &BatchLayout, slot: &mut [u8]) {
        let mut bytes = Vec::with_capacity(SLOT_HEADER_BYTES);
        bytes.extend(SLOT_MAGIC);
        bytes.extend(SLOT_VERSION.to_le_bytes());
        bytes.extend((SLOT_HEADER_BYTES as u32).to_le_bytes());
        for hash in [layout.hash(), self.schema_hash, self.stream_hash] {
            bytes.extend(hash.0);
        }
        for number in [self.n, self.batch.epoch, self.batch.step] {
            bytes.extend(number.to_le_bytes());
        }
        let clips = self.clips as u32;
        let split = self.batch.split.code();
        for number in [split, self.loader, self.loaders, self.rank, self.ranks, clips] {
            bytes.extend(number.to_le_bytes());
        }
        for axis in axes(layout.shape()) {
            bytes.extend((axis as u32).to_le_bytes());
        }
        for section in Section::ALL {
            bytes.extend((layout.offset(section) as u64).to_le_bytes());
        }
        bytes.extend((layout.total_bytes() as u64).to_le_bytes());
        bytes.resize(CHECKED_BYTES, 0);
        let checksum = ContentHash::of(&bytes);
        bytes.extend(checksum.0);
        slot[..SLOT_HEADER_BYTES].copy_from_slice(&bytes);
    }

    /// Copies the header out of a slot, then checks the copy: whole, of this version, and of exactly this layout.
    ///
    /// # Errors
    /// - [`BatchError::Short`] if there is no room for a header
    /// - [`BatchError::Header`] for the first field that is not as it must be
    pub fn read(layout: &BatchLayout, slot: &[u8]) -> Result<SlotHeader, BatchError> {
        let got = slot.len();
        let Some(copy) = slot.first_chunk::<SLOT_HEADER_BYTES>().copied() else {
            return Err(BatchError::Short { expected: SLOT_HEADER_BYTES, got });
        };
        let mut fields = Fields { bytes: &copy };
        let magic = fields.take();
        if magic != SLOT_MAGIC {
            return Err(wrong("magic", SLOT_MAGIC.escape_ascii(), magic.escape_ascii()));
        }
        expect("version", &SLOT_VERSION, &fields.u32())?;
        expect("checksum", &ContentHash::of(&copy[..CHECKED_BYTES]), &checksum(&copy))?;
        expect("header length", &(SLOT_HEADER_BYTES as u32), &fields.u32())?;
        expect("layout hash", &layout.hash(), &fields.hash())?;
        let (schema_hash, stream_hash) = (fields.hash(), fields.hash());
        let (n, epoch, step) = (fields.u64(), fields.u64(), fields.u64());
        let split = fields.u32();
        let Some(split) = Split::from_code(split) else {
            return Err(wrong("split", "0 or 1", split));
        };
        let [loader, loaders, rank, ranks] = [(); 4].map(|()| fields.u32());
        if loader >= loaders {
            return Err(wrong("loader", format!("below {loaders}"), loader));
        }
        if rank >= ranks {
            return Err(wrong("rank", format!("below {ranks}"), rank));
        }
        let clips = fields.u32() as usize;
        let most = layout.shape().clips;
        if clips == 0 || clips > most {
            return Err(wrong("number of clips", format!("1 to {most}"), clips));
        }
        for axis in axes(layout.shape()) {
            expect("shape", &(axis as u32), &fields.u32())?;
        }
        for section in Section::ALL {
            expect(section.name(), &(layout.offset(section) as u64), &fields.u64())?;
        }
        expect("length", &(layout.total_bytes() as u64), &fields.u64())?;
        let batch = BatchId { split, epoch, step };
        Ok(SlotHeader { schema_hash, stream_hash, n, batch, loader, loaders, rank, ranks, clips })
    }
}

fn axes(shape: &BatchShape) -> [usize; 8] {
    let BatchShape { clips, frames, views, height, width, channels, action_width, state_width } = *shape;
    [clips, frames, views, height, width, channels, action_width, state_width]
}

fn checksum(header: &[u8; SLOT_HEADER_BYTES]) -> ContentHash {
    let mut hash = [0; 32];
    hash.copy_from_slice(&header[CHECKED_BYTES..]);
    ContentHash(hash)
}

fn expect<T: PartialEq + std::fmt::Display>(
    field: &'static str,
    expected: &T,
    got: &T,
) -> Result<(), BatchError> {
    if expected == got { Ok(()) } else { Err(wrong(field, expected, got)) }
}

fn wrong(field: &'static str, expected: impl ToString, got: impl ToString) -> BatchError {
    BatchError::Header { field, expected: expected.to_string(), got: got.to_string() }
}

/// Takes fields off the front of a header.
struct Fields<'a> {
    bytes: &'a [u8],
}

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (field, rest) = self.bytes.split_first_chunk().expect("the fields add up to less than a header");
        self.bytes = rest;
        *field
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }

    fn hash(&mut self) -> ContentHash {
        ContentHash(self.take())
    }
}
