//! The physical limit that `gawm-ingest run` is measured against: reads a log with every CRC checked and writes the
//! payload of each message once, in order, to one file, with fsync.
//!
//! ```text
//! cargo run --release -p gawm-ingest --example copy_payload -- LOG.mcap OUT.bin
//! ```

use std::fs::File;
use std::io::{BufWriter, Read, Write};

use anyhow::{Context, Result, bail};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [log, out] = arguments.as_slice() else { bail!("usage: copy_payload LOG.mcap OUT.bin") };
    let mut input = File::open(log).with_context(|| format!("opening {log}"))?;
    let mut output =
        BufWriter::with_capacity(1 << 20, File::create(out).with_context(|| format!("creating {out}"))?);
    let options =
        LinearReaderOptions::default().with_validate_chunk_crcs(true).with_validate_data_section_crc(true);
    let mut reader = LinearReader::new_with_options(options);
    let (mut messages, mut bytes) = (0u64, 0u64);
    while let Some(event) = reader.next_event() {
        match event? {
            LinearReadEvent::ReadRequest(wanted) => {
                let read = input.read(reader.insert(wanted))?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { data, opcode } if opcode == mcap::records::op::MESSAGE => {
                let payload = data.get(22..).context("a message record is shorter than its header")?;
                output.write_all(payload)?;
                messages += 1;
                bytes += payload.len() as u64;
            }
            LinearReadEvent::Record { .. } => {}
        }
    }
    output.into_inner()?.sync_all()?;
    println!("{log}: {messages} messages, {bytes} payload bytes");
    Ok(())
}
