//! Any bytes as a log: opened, every block read, every attachment read, and inspected.
#![no_main]

use std::path::Path;

use bytes::Bytes;
use gawm_ingest::inspect::{DecoderProbe, inspect_log};
use gawm_ingest::log::{Log, OpenOptions};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    // Small limits, so that a finding is a missing check and not a large allocation that is allowed.
    let options = OpenOptions { max_record_bytes: 1 << 20, max_chunk_bytes: 1 << 20, ..OpenOptions::default() };
    let path = Path::new("fuzz.mcap");
    let Ok(log) = Log::from_bytes(path, Bytes::copy_from_slice(data), &options) else { return };
    for block_ref in log.blocks() {
        let block = log.read_block(block_ref);
        for message in &block.messages {
            std::hint::black_box((block.channel(message), block.payload(message).len()));
        }
    }
    for index in 0..log.attachments().len() {
        std::hint::black_box(log.read_attachment(index).is_ok());
    }
    std::hint::black_box(inspect_log(&log, path, &DecoderProbe::default()));
});
