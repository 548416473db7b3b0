//! The decoders behind the reader: any bytes as a chunk's compressed data and as a compressed message body.
#![no_main]

use gawm_ingest::log::decompress_message;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    if let Ok(body) = decompress_message(data, 1 << 20) {
        assert!(body.len() <= 1 << 20);
    }
});
