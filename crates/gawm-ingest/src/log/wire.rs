//! The MCAP records as they lie in the file, and the one cursor that parses them.
//!
//! Every parser returns `None` when a field runs past the end of the record; bytes after the last known field are ignored.

use std::collections::BTreeMap;

/// The eight bytes at both ends of an MCAP file.
pub(crate) const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', b'0', b'\r', b'\n'];
/// Opcode (1 byte) and length (8 bytes, little endian) before every record.
pub(crate) const RECORD_PREFIX: u64 = 9;
/// Bytes of a chunk record before its compression string and data.
pub(crate) const CHUNK_FIXED: u64 = 8 + 8 + 8 + 4 + 4 + 8;
/// Bytes of a message record before its payload.
pub(crate) const MESSAGE_FIXED: u64 = 2 + 4 + 8 + 8;
/// A footer record with its prefix: three fields of 8, 8 and 4 bytes.
pub(crate) const FOOTER_RECORD: u64 = RECORD_PREFIX + 20;

/// Record opcodes.
pub(crate) mod op {
    pub(crate) const HEADER: u8 = 0x01;
    pub(crate) const FOOTER: u8 = 0x02;
    pub(crate) const SCHEMA: u8 = 0x03;
    pub(crate) const CHANNEL: u8 = 0x04;
    pub(crate) const MESSAGE: u8 = 0x05;
    pub(crate) const CHUNK: u8 = 0x06;
    pub(crate) const MESSAGE_INDEX: u8 = 0x07;
    pub(crate) const CHUNK_INDEX: u8 = 0x08;
    pub(crate) const ATTACHMENT: u8 = 0x09;
    pub(crate) const ATTACHMENT_INDEX: u8 = 0x0A;
    pub(crate) const STATISTICS: u8 = 0x0B;
    pub(crate) const METADATA: u8 = 0x0C;
    pub(crate) const METADATA_INDEX: u8 = 0x0D;
    pub(crate) const SUMMARY_OFFSET: u8 = 0x0E;
    pub(crate) const DATA_END: u8 = 0x0F;
}

/// Reads little-endian fields from the front of a slice.
#[derive(Debug, Clone)]
pub(crate) struct Cursor<'a> {
    rest: &'a [u8],
}

impl<'a> Cursor<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes }
    }

    /// Bytes not read yet.
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    pub(crate) fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.rest.split_at_checked(n)?;
        self.rest = rest;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.rest.split_first_chunk::<N>()?;
        self.rest = rest;
        Some(*head)
    }

    pub(crate) fn u8(&mut self) -> Option<u8> {
        self.array::<1>().map(|b| b[0])
    }

    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    /// Reads a length-prefixed string; bytes that are not UTF-8 become U+FFFD.
    pub(crate) fn string(&mut self) -> Option<String> {
        let n = usize::try_from(self.u32()?).ok()?;
        self.take(n).map(|b| String::from_utf8_lossy(b).into_owned())
    }

    /// Returns the bytes of a map or an array that its u32 byte length announces.
    fn sized(&mut self) -> Option<Cursor<'a>> {
        let n = usize::try_from(self.u32()?).ok()?;
        self.take(n).map(Cursor::new)
    }

    fn string_map(&mut self) -> Option<BTreeMap<String, String>> {
        let mut inner = self.sized()?;
        let mut map = BTreeMap::new();
        while !inner.rest.is_empty() {
            let key = inner.string()?;
            map.insert(key, inner.string()?);
        }
        Some(map)
    }

    fn count_map(&mut self) -> Option<BTreeMap<u16, u64>> {
        let mut inner = self.sized()?;
        let mut map = BTreeMap::new();
        while !inner.rest.is_empty() {
            let key = inner.u16()?;
            map.insert(key, inner.u64()?);
        }
        Some(map)
    }
}

/// A record whose fields can be parsed from its body.
pub(crate) trait Parse<'a>: Sized {
    /// Parses the body of a record, `None` when a field is cut off.
    fn parse(body: &'a [u8]) -> Option<Self>;
}

macro_rules! records {
    ($($(#[$doc:meta])* $name:ident $(<$life:lifetime>)? { $($field:ident : $ty:ty = $read:ident),* $(,)? })*) => {$(
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq)]
        pub(crate) struct $name $(<$life>)? { $(pub(crate) $field: $ty),* }

        impl<'a> Parse<'a> for $name $(<$life>)? {
            fn parse(body: &'a [u8]) -> Option<Self> {
                let mut cursor = Cursor::new(body);
                $(let $field = cursor.$read()?;)*
                Some(Self { $($field),* })
            }
        }
    )*};
}

records! {
    /// The first record of a file.
    Header { profile: String = string, library: String = string }
    /// The last record of a file.
    Footer { summary_start: u64 = u64, summary_offset_start: u64 = u64, summary_crc: u32 = u32 }
    /// A message schema.
    SchemaRecord<'a> { id: u16 = u16, name: String = string, encoding: String = string, data: &'a [u8] = blob32 }
    /// A channel.
    ChannelRecord {
        id: u16 = u16, schema_id: u16 = u16, topic: String = string, message_encoding: String = string,
        metadata: BTreeMap<String, String> = string_map,
    }
    /// What comes before the payload of a message.
    MessageHeader { channel_id: u16 = u16, sequence: u32 = u32, log_time: u64 = u64, publish_time: u64 = u64 }
    /// What comes before the data of a chunk.
    ChunkHeader {
        start_time: u64 = u64, end_time: u64 = u64, uncompressed_size: u64 = u64, uncompressed_crc: u32 = u32,
        compression: String = string, compressed_size: u64 = u64,
    }
    /// Where the messages of one channel lie in the chunk before it.
    MessageIndex { channel_id: u16 = u16, entries: Vec<(u64, u64)> = time_offset_pairs }
    /// Where a chunk lies.
    ChunkIndex {
        start_time: u64 = u64, end_time: u64 = u64, chunk_start_offset: u64 = u64, chunk_length: u64 = u64,
        message_index_offsets: BTreeMap<u16, u64> = count_map, message_index_length: u64 = u64,
        compression: String = string, compressed_size: u64 = u64, uncompressed_size: u64 = u64,
    }
    /// An attachment before its data.
    AttachmentHeader {
        log_time: u64 = u64, create_time: u64 = u64, name: String = string, media_type: String = string,
        data_size: u64 = u64,
    }
    /// Where an attachment lies.
    AttachmentIndex {
        offset: u64 = u64, length: u64 = u64, log_time: u64 = u64, create_time: u64 = u64, data_size: u64 = u64,
        name: String = string, media_type: String = string,
    }
    /// What the writer counted.
    Statistics {
        message_count: u64 = u64, schema_count: u16 = u16, channel_count: u32 = u32, attachment_count: u32 = u32,
        metadata_count: u32 = u32, chunk_count: u32 = u32, message_start_time: u64 = u64, message_end_time: u64 = u64,
        channel_message_counts: BTreeMap<u16, u64> = count_map,
    }
    /// Named key-value pairs.
    Metadata { name: String = string, metadata: BTreeMap<String, String> = string_map }
    /// Where a metadata record lies.
    MetadataIndex { offset: u64 = u64, length: u64 = u64, name: String = string }
    /// Where a group of summary records lies.
    SummaryOffset { group_opcode: u8 = u8, group_start: u64 = u64, group_length: u64 = u64 }
    /// The end of the data section.
    DataEnd { data_section_crc: u32 = u32 }
}

impl<'a> Cursor<'a> {
    fn blob32(&mut self) -> Option<&'a [u8]> {
        self.sized().map(|c| c.rest)
    }

    fn time_offset_pairs(&mut self) -> Option<Vec<(u64, u64)>> {
        let mut inner = self.sized()?;
        let mut entries = Vec::with_capacity(inner.rest.len() / 16);
        while !inner.rest.is_empty() {
            let time = inner.u64()?;
            entries.push((time, inner.u64()?));
        }
        Some(entries)
    }
}

/// The opcode and the body length of the record that starts here.
pub(crate) fn record_prefix(bytes: &[u8]) -> Option<(u8, u64)> {
    let mut cursor = Cursor::new(bytes);
    Some((cursor.u8()?, cursor.u64()?))
}

/// Splits whole records off the front of a byte slice.
///
/// Ends at the first record that does not fit; [`Records::rest`] then holds what is left.
#[derive(Debug, Clone)]
pub(crate) struct Records<'a> {
    bytes: &'a [u8],
    at: usize,
}

/// One whole record of a slice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RawRecord<'a> {
    /// Opcode.
    pub(crate) op: u8,
    /// Position of the opcode in the slice.
    pub(crate) at: usize,
    /// Body without the prefix.
    pub(crate) body: &'a [u8],
}

impl<'a> Records<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// Position after the last whole record.
    pub(crate) fn position(&self) -> usize {
        self.at
    }

    /// Bytes that no whole record covers.
    pub(crate) fn rest(&self) -> &'a [u8] {
        &self.bytes[self.at..]
    }
}

impl<'a> Iterator for Records<'a> {
    type Item = RawRecord<'a>;

    fn next(&mut self) -> Option<RawRecord<'a>> {
        let mut cursor = Cursor::new(self.rest());
        let op = cursor.u8()?;
        let length = usize::try_from(cursor.u64()?).ok()?;
        let body = cursor.take(length)?;
        let at = self.at;
        self.at = self.bytes.len() - cursor.rest().len();
        Some(RawRecord { op, at, body })
    }
}
