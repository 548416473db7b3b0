//! The element of a slot, and the two places where its memory becomes bytes.
#![expect(unsafe_code, reason = "shared memory is handed out by iceoryx2 as uninitialised elements")]

use std::mem::MaybeUninit;

use iceoryx2::prelude::ZeroCopySend;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;

use crate::domain::Ipc;

/// Bytes of a [`Chunk`].
pub(crate) const CHUNK_BYTES: usize = 64;

/// A cache line of a slot.
///
/// iceoryx2 aligns a slice by its element. An element of 64 bytes aligns slots as the layout wants them; asking for the
/// alignment of a slice of bytes instead would multiply the reserved memory by it.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Chunk([u8; CHUNK_BYTES]);

// SAFETY: the trait wants a type that is self-contained (no pointers, no handles), has a fixed layout (`repr(C)`), no
// `Drop`, and may be used from several processes. `Chunk` is 64 plain bytes.
unsafe impl ZeroCopySend for Chunk {
    // SAFETY of callers: the name stands for this layout in any language; it changes when the layout does.
    unsafe fn type_name() -> &'static str {
        "gawm.slot.chunk.v1"
    }
}

/// Returns the number of chunks that hold so many bytes.
pub(crate) fn chunks_of(bytes: usize) -> usize {
    bytes.div_ceil(CHUNK_BYTES)
}

/// Views received chunks as bytes.
pub(crate) fn bytes(chunks: &[Chunk]) -> &[u8] {
    // SAFETY: of `slice::from_raw_parts`: the pointer comes from a reference to `chunks.len()` chunks, which are
    // `64 * chunks.len()` contiguous bytes of one allocation without padding (`size_of::<Chunk>() == 64`, checked
    // below); every byte of a `Chunk` is a `u8`, hence initialised and valid; `u8` has alignment 1; the returned
    // lifetime is that of the borrow, so nothing is written through this process meanwhile. Other processes do not
    // write to a slot after publishing it (the threat model excludes a hostile writer, see `docs/formats/slot.md`). The
    // length is below `isize::MAX` since the slice existed.
    unsafe { std::slice::from_raw_parts(chunks.as_ptr().cast::<u8>(), size_of_val(chunks)) }
}

/// Views loaned chunks as bytes; they hold whatever an earlier use of the slot left.
pub(crate) fn loaned_bytes(chunks: &[MaybeUninit<Chunk>]) -> &[u8] {
    // SAFETY: of `slice::from_raw_parts`: pointer, length, alignment and lifetime as in `bytes`. The bytes are initialised
    // although their type says that they may not be: the slot lies in a POSIX shared-memory object, whose pages the kernel
    // fills with zeros before a process can see them (ftruncate(3p): "the extended area shall appear as if it were
    // zero-filled"), and they were obtained by `mmap`, about whose bytes the compiler can assume nothing. Any byte is a
    // valid `u8`.
    unsafe { std::slice::from_raw_parts(chunks.as_ptr().cast::<u8>(), size_of_val(chunks)) }
}

/// Views loaned chunks as bytes that can be written.
pub(crate) fn loaned_bytes_mut(chunks: &mut [MaybeUninit<Chunk>]) -> &mut [u8] {
    let length = size_of_val(chunks);
    // SAFETY: of `slice::from_raw_parts_mut`: the pointer comes from a unique reference to `length` contiguous bytes of one
    // allocation, and that borrow lasts as long as the result; `u8` has alignment 1; the bytes are initialised, see
    // `loaned_bytes`, and nothing that can be written to a `u8` makes a `MaybeUninit<Chunk>` invalid.
    unsafe { std::slice::from_raw_parts_mut(chunks.as_mut_ptr().cast::<u8>(), length) }
}

/// Turns a loan into a sample that can be sent.
pub(crate) fn assume_filled(
    loan: SampleMutUninit<Ipc, [MaybeUninit<Chunk>], ()>,
) -> SampleMut<Ipc, [Chunk], ()> {
    // SAFETY: of `SampleMutUninit::assume_init`: it wants every element initialised. A `Chunk` is 64 bytes, and the bytes
    // of a slot are initialised from the moment it is mapped, see `loaned_bytes`.
    unsafe { loan.assume_init() }
}

const _: () = assert!(size_of::<Chunk>() == CHUNK_BYTES && align_of::<Chunk>() == CHUNK_BYTES);
// Slots are read as little-endian numbers in place.
const _: () = assert!(cfg!(target_endian = "little"));
