//! Any bytes as a hello message: refused, or consistent enough that its layout and sequence can be used.
#![no_main]

use gawm_schema::batch::Hello;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Ok(hello) = Hello::from_json(data) else { return };
    assert_eq!(hello.layout().expect("it was checked").hash(), hello.layout_hash);
    let batches = hello.sequence.batches();
    for n in [0, batches / 2, batches.saturating_sub(1), batches, u64::MAX] {
        assert_eq!(hello.sequence.batch(n).is_some(), n < batches);
    }
    assert_eq!(Hello::from_json(hello.to_json().as_bytes()).as_ref(), Ok(&hello));
});
