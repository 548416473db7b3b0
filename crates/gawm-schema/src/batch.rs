//! Batches between processes: their order, their layout in a slot, their header, checked views.
//!
//! A [`Sequence`] says which [`BatchId`] the n-th batch of a run is, for any number of loaders. A [`BatchShape`] has one
//! [`BatchLayout`]; [`SlotHeader::write`] and [`SectionsMut`] fill a slot, a [`BatchView`] reads it. Loaders introduce
//! themselves with a [`Hello`], which says everything else that a trainer must know about the data.
//!
//! Shapes: `B` clips, `T` frames of a clip, `V` views (cameras), `H` rows and `W` columns of pixels, `C` channels,
//! `A` action width (frameskip times the dims of the encoded action), `S` state width. The bytes are drawn in
//! `docs/formats/slot.md`.
//!
//! The order of sections (large ones in the middle, all 64-byte aligned) is fixed and written out in the header all the
//! same: a reader in another language needs the header only.
//!
//! **Invariant**: no byte sequence makes a view break; a view never reaches outside the bytes that it was given.

mod header;
mod hello;
mod layout;
mod sequence;
mod view;

pub use header::{SLOT_HEADER_BYTES, SLOT_MAGIC, SLOT_VERSION, SlotHeader};
pub use hello::{
    Baselines, ClipCounts, DatasetInfo, EncodedFeature, HELLO_VERSION, Hello, HelloError, StandardisedDimInfo,
};
pub use layout::{BatchLayout, BatchShape, SECTION_ALIGNMENT, Section};
pub use sequence::{BatchId, Sequence, SequenceError, Split};
pub use view::{BatchView, SectionsMut};

/// Why bytes are not the batch that is expected, or a layout cannot be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum BatchError {
    /// A batch of this shape cannot be laid out.
    #[error("unusable batch shape: expected {expected}, got {field} {got}")]
    Shape {
        /// The field of [`BatchShape`].
        field: &'static str,
        /// What is possible.
        expected: &'static str,
        /// The value.
        got: u64,
    },
    /// The slot is shorter than its layout.
    #[error("slot too short: expected {expected} bytes, got {got}")]
    Short {
        /// Bytes that the layout or the header needs.
        expected: usize,
        /// Bytes that are there.
        got: usize,
    },
    /// The memory of the slot does not begin at a multiple of 64 bytes.
    #[error(
        "slot not aligned: expected an address that is a multiple of {SECTION_ALIGNMENT}, got remainder {got}"
    )]
    Unaligned {
        /// The remainder.
        got: usize,
    },
    /// A field of the header has another value than the reader needs.
    #[error("foreign, stale or torn slot: expected {field} {expected}, got {got}")]
    Header {
        /// The field of the header.
        field: &'static str,
        /// The value that would do.
        expected: String,
        /// The value found.
        got: String,
    },
}

#[cfg(test)]
mod tests;
