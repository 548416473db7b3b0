//! Any bytes as a slot: a view is refused, or everything that it gives access to can be read.
#![no_main]

use gawm_schema::ContentHash;
use gawm_schema::batch::{BatchId, BatchLayout, BatchShape, BatchView, SLOT_HEADER_BYTES, SlotHeader, Split};
use libfuzzer_sys::fuzz_target;

fn header() -> SlotHeader {
    SlotHeader {
        schema_hash: ContentHash::of(b"schema"),
        stream_hash: ContentHash::of(b"stream"),
        n: 1,
        batch: BatchId { split: Split::Train, epoch: 0, step: 1 },
        loader: 1,
        loaders: 2,
        rank: 0,
        ranks: 1,
        clips: 3,
    }
}

fuzz_target!(|data: &[u8]| {
    let [flags, data @ ..] = data else { return };
    let shape = BatchShape {
        clips: 3,
        frames: 2,
        views: 2,
        height: 3,
        width: 5,
        channels: 3,
        action_width: 3,
        state_width: 2,
    };
    let layout = BatchLayout::try_new(shape).expect("a possible shape");
    let mut memory = vec![0; data.len() + 64];
    let start = memory.as_ptr().align_offset(64);
    let slot = &mut memory[start..start + data.len()];
    // Half of the inputs say what differs from a good slot, so that more than the magic is reached.
    if flags & 2 == 2 && data.len() >= SLOT_HEADER_BYTES {
        header().write(&layout, slot);
    }
    for (byte, change) in slot.iter_mut().zip(data) {
        *byte ^= change;
    }
    // Every second input gets a right checksum, so that the fields behind it are reached.
    if flags & 1 == 1 && data.len() >= SLOT_HEADER_BYTES {
        let checksum = ContentHash::of(&slot[..288]);
        slot[288..SLOT_HEADER_BYTES].copy_from_slice(&checksum.0);
    }
    let Ok(view) = BatchView::try_new(&layout, slot) else { return };
    let clips = view.shape().clips;
    assert!((1..=3).contains(&clips));
    assert_eq!(view.frames().len(), clips * 2 * 2 * 45);
    let bytes = [view.frames(), view.action_mask(), view.state_mask(), view.frame_mask()].concat();
    let numbers: f64 = view.actions().iter().chain(view.states()).map(|v| f64::from(*v)).sum();
    std::hint::black_box((bytes, numbers, view.clip_ids()));
});
