//! Any bytes as a slot: a view is refused, or everything that it gives access to can be read.
#![no_main]

use gawm_schema::ContentHash;
use gawm_schema::batch::{BatchLayout, BatchShape, BatchView, SLOT_HEADER_BYTES};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
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
    slot.copy_from_slice(data);
    // Every second input gets a right checksum, so that the fields behind it are reached.
    if data.len() >= SLOT_HEADER_BYTES && data[data.len() - 1] & 1 == 1 {
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
