//! Every record of an MCAP file as the MCAP conformance tests write it.
//!
//! The JSON is `{"records": [{"type": "Header", "fields": [["library", ""], …]}, …]}`: fields in alphabetical order, numbers
//! as decimal strings, bytes as lists of such strings, maps as objects. Chunks are opened and their records listed in their
//! place; `Chunk` and `MessageIndex` records themselves are left out. Records of unknown opcodes are skipped, as the
//! specification asks readers to.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::log::wire::{
    AttachmentHeader, AttachmentIndex, ChannelRecord, ChunkIndex, DataEnd, Footer, Header, MESSAGE_FIXED,
    MessageHeader, Metadata, MetadataIndex, Parse, RawRecord, SchemaRecord, Statistics, SummaryOffset, op,
};
use crate::log::{Damage, OpenLogError, OpenOptions, RecordSource};

/// One record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordJson {
    /// Names and values of the fields, by name.
    pub fields: Vec<(&'static str, Value)>,
    /// Name of the record's type.
    #[serde(rename = "type")]
    pub kind: &'static str,
}

/// Writes every record of a file as one JSON document, without holding more than one chunk in memory.
///
/// Returns the damage that kept records from being listed.
///
/// # Errors
/// - [`RecordsError::Open`]: the file is no MCAP file.
/// - [`RecordsError::Write`]: `out` cannot be written.
pub fn write_records(
    path: &Path,
    options: &OpenOptions,
    out: &mut dyn Write,
) -> Result<Vec<Damage>, RecordsError> {
    let source = RecordSource::open(path, options)?;
    let mut n_written = 0;
    let mut result = Ok(());
    out.write_all(b"{\"records\":[")?;
    let damage = source.for_each(&mut |record| {
        if let (Some(record), Ok(())) = (record_json(&record), &result) {
            let separator: &[u8] = if n_written == 0 { b"\n" } else { b",\n" };
            n_written += 1;
            result = out
                .write_all(separator)
                .and_then(|()| serde_json::to_writer(&mut *out, &record).map_err(io::Error::from));
        }
    });
    result?;
    out.write_all(b"\n]}\n")?;
    Ok(damage)
}

/// Why the records of a file cannot be printed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordsError {
    /// The file cannot be opened as a log.
    #[error(transparent)]
    Open(#[from] OpenLogError),
    /// The output cannot be written.
    #[error("cannot write the records: {0}")]
    Write(#[from] io::Error),
}

/// Returns the JSON of a record; `None` for those that are left out.
pub(crate) fn record_json(record: &RawRecord<'_>) -> Option<RecordJson> {
    let body = record.body;
    let (kind, fields) = match record.op {
        op::HEADER => ("Header", header(&Header::parse(body)?)),
        op::FOOTER => ("Footer", footer(&Footer::parse(body)?)),
        op::SCHEMA => ("Schema", schema(&SchemaRecord::parse(body)?)),
        op::CHANNEL => ("Channel", channel(&ChannelRecord::parse(body)?)),
        op::MESSAGE => ("Message", message(body)?),
        op::CHUNK_INDEX => ("ChunkIndex", chunk_index(&ChunkIndex::parse(body)?)),
        op::ATTACHMENT => ("Attachment", attachment(body)?),
        op::ATTACHMENT_INDEX => ("AttachmentIndex", attachment_index(&AttachmentIndex::parse(body)?)),
        op::STATISTICS => ("Statistics", statistics(&Statistics::parse(body)?)),
        op::METADATA => ("Metadata", metadata(&Metadata::parse(body)?)),
        op::METADATA_INDEX => ("MetadataIndex", metadata_index(&MetadataIndex::parse(body)?)),
        op::SUMMARY_OFFSET => ("SummaryOffset", summary_offset(&SummaryOffset::parse(body)?)),
        op::DATA_END => {
            ("DataEnd", vec![("data_section_crc", number(DataEnd::parse(body)?.data_section_crc))])
        }
        _ => return None,
    };
    Some(RecordJson { fields, kind })
}

type Fields = Vec<(&'static str, Value)>;

fn number(value: impl Into<u64>) -> Value {
    Value::String(value.into().to_string())
}

fn bytes(value: &[u8]) -> Value {
    value.iter().map(|&byte| number(byte)).collect()
}

fn strings(map: &BTreeMap<String, String>) -> Value {
    Value::Object(map.iter().map(|(key, value)| (key.clone(), json!(value))).collect::<Map<_, _>>())
}

fn numbers(map: &BTreeMap<u16, u64>) -> Value {
    Value::Object(map.iter().map(|(key, &value)| (key.to_string(), number(value))).collect::<Map<_, _>>())
}

fn header(r: &Header) -> Fields {
    vec![("library", json!(r.library)), ("profile", json!(r.profile))]
}

fn footer(r: &Footer) -> Fields {
    vec![
        ("summary_crc", number(r.summary_crc)),
        ("summary_offset_start", number(r.summary_offset_start)),
        ("summary_start", number(r.summary_start)),
    ]
}

fn schema(r: &SchemaRecord<'_>) -> Fields {
    vec![
        ("data", bytes(r.data)),
        ("encoding", json!(r.encoding)),
        ("id", number(r.id)),
        ("name", json!(r.name)),
    ]
}

fn channel(r: &ChannelRecord) -> Fields {
    vec![
        ("id", number(r.id)),
        ("message_encoding", json!(r.message_encoding)),
        ("metadata", strings(&r.metadata)),
        ("schema_id", number(r.schema_id)),
        ("topic", json!(r.topic)),
    ]
}

fn message(body: &[u8]) -> Option<Fields> {
    let r = MessageHeader::parse(body)?;
    Some(vec![
        ("channel_id", number(r.channel_id)),
        ("data", bytes(body.get(MESSAGE_FIXED as usize..)?)),
        ("log_time", number(r.log_time)),
        ("publish_time", number(r.publish_time)),
        ("sequence", number(r.sequence)),
    ])
}

fn chunk_index(r: &ChunkIndex) -> Fields {
    vec![
        ("chunk_length", number(r.chunk_length)),
        ("chunk_start_offset", number(r.chunk_start_offset)),
        ("compressed_size", number(r.compressed_size)),
        ("compression", json!(r.compression)),
        ("message_end_time", number(r.end_time)),
        ("message_index_length", number(r.message_index_length)),
        ("message_index_offsets", numbers(&r.message_index_offsets)),
        ("message_start_time", number(r.start_time)),
        ("uncompressed_size", number(r.uncompressed_size)),
    ]
}

fn attachment(body: &[u8]) -> Option<Fields> {
    let r = AttachmentHeader::parse(body)?;
    let from = 8 + 8 + 4 + r.name.len() + 4 + r.media_type.len() + 8;
    let data = body.get(from..from.checked_add(usize::try_from(r.data_size).ok()?)?)?;
    Some(vec![
        ("create_time", number(r.create_time)),
        ("data", bytes(data)),
        ("log_time", number(r.log_time)),
        ("media_type", json!(r.media_type)),
        ("name", json!(r.name)),
    ])
}

fn attachment_index(r: &AttachmentIndex) -> Fields {
    vec![
        ("create_time", number(r.create_time)),
        ("data_size", number(r.data_size)),
        ("length", number(r.length)),
        ("log_time", number(r.log_time)),
        ("media_type", json!(r.media_type)),
        ("name", json!(r.name)),
        ("offset", number(r.offset)),
    ]
}

fn statistics(r: &Statistics) -> Fields {
    vec![
        ("attachment_count", number(r.attachment_count)),
        ("channel_count", number(r.channel_count)),
        ("channel_message_counts", numbers(&r.channel_message_counts)),
        ("chunk_count", number(r.chunk_count)),
        ("message_count", number(r.message_count)),
        ("message_end_time", number(r.message_end_time)),
        ("message_start_time", number(r.message_start_time)),
        ("metadata_count", number(r.metadata_count)),
        ("schema_count", number(r.schema_count)),
    ]
}

fn metadata(r: &Metadata) -> Fields {
    vec![("metadata", strings(&r.metadata)), ("name", json!(r.name))]
}

fn metadata_index(r: &MetadataIndex) -> Fields {
    vec![("length", number(r.length)), ("name", json!(r.name)), ("offset", number(r.offset))]
}

fn summary_offset(r: &SummaryOffset) -> Fields {
    vec![
        ("group_length", number(r.group_length)),
        ("group_opcode", number(r.group_opcode)),
        ("group_start", number(r.group_start)),
    ]
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use serde_json::Value;

    use super::write_records;
    use crate::log::OpenOptions;

    /// Compares a file's records with the JSON beside it.
    fn check_conformance(path: &Path) {
        let mut out = Vec::new();
        let damage = write_records(path, &OpenOptions::default(), &mut out).unwrap();
        assert_eq!(damage, [], "{path:?}");
        let got: Value = serde_json::from_slice(&out).unwrap();
        let expected: Value =
            serde_json::from_slice(&std::fs::read(path.with_extension("json")).unwrap()).unwrap();
        assert_eq!(got["records"], expected["records"], "{path:?}");
    }

    fn check_folder(folder: &Path, at_least: usize) {
        let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        let files: Vec<PathBuf> =
            entries.filter(|path| path.extension().is_some_and(|ending| ending == "mcap")).collect();
        assert!(
            files.len() >= at_least,
            "expected at least {at_least} files, got {}: {folder:?}",
            files.len()
        );
        files.iter().for_each(|path| check_conformance(path));
    }

    #[test]
    fn committed_conformance_files_give_their_records() {
        check_folder(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/mcap_conformance"), 8);
    }

    #[test]
    fn all_conformance_files_give_their_records() {
        let Some(shared) = std::env::var_os("GAWM_SHARED") else {
            println!("skipped: GAWM_SHARED is not set");
            return;
        };
        check_folder(&Path::new(&shared).join("corpora/mcap_conformance"), 321);
    }
}
