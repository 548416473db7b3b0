//! What is wrong with a log: the kinds, and one finding.

use serde::Serialize;

/// One finding about the bytes of a log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Damage {
    /// What is wrong.
    pub kind: DamageKind,
    /// File offset of the record (or of the chunk that holds it).
    pub offset: u64,
    /// What was expected, what was there, and what was done about it.
    pub detail: String,
}

impl Damage {
    pub(crate) fn new(kind: DamageKind, offset: u64, detail: impl Into<String>) -> Self {
        Self { kind, offset, detail: detail.into() }
    }
}

/// How bad a kind of damage is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Nothing is lost and nothing is in doubt.
    Notice,
    /// Nothing is known to be lost, but what was read could not be checked in full.
    Doubt,
    /// Messages, attachments or metadata are lost.
    Loss,
}

macro_rules! damage_kinds {
    ($($(#[doc = $doc:literal])* $name:ident = $snake:literal, $severity:ident;)*) => {
        /// The kinds of damage; `docs/formats/inspect.md` says what each means and what was done.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
        #[non_exhaustive]
        pub enum DamageKind {
            $($(#[doc = $doc])* #[serde(rename = $snake)] $name,)*
        }

        impl DamageKind {
            /// Every kind, in the order of the documentation.
            pub const ALL: &'static [DamageKind] = &[$(DamageKind::$name),*];

            /// Returns the name of the kind in JSON.
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$name => $snake),* }
            }

            /// Returns how bad this kind is.
            pub fn severity(self) -> Severity {
                match self { $(Self::$name => Severity::$severity),* }
            }
        }
    };
}

damage_kinds! {
    /// The first eight bytes are not the MCAP magic, though records follow.
    BadStartMagic = "bad_start_magic", Doubt;
    /// The last eight bytes are not the MCAP magic, though a footer precedes them.
    BadEndMagic = "bad_end_magic", Notice;
    /// The file ends inside a record.
    Truncated = "truncated", Loss;
    /// The records end without a footer, at a record's border.
    MissingFooter = "missing_footer", Doubt;
    /// Bytes follow the end magic.
    TrailingBytes = "trailing_bytes", Loss;
    /// The footer points to a summary that cannot be read.
    SummaryUnreadable = "summary_unreadable", Doubt;
    /// The CRC of the summary section differs.
    SummaryCrcMismatch = "summary_crc_mismatch", Doubt;
    /// The CRC of the data section differs.
    DataSectionCrcMismatch = "data_section_crc_mismatch", Doubt;
    /// An index entry does not describe what lies at its offset.
    IndexMismatch = "index_mismatch", Doubt;
    /// The summary's index leaves out chunks or messages outside chunks.
    IndexIncomplete = "index_incomplete", Notice;
    /// The statistics of the writer differ from what was read.
    StatisticsMismatch = "statistics_mismatch", Doubt;
    /// A record's length does not fit where it lies.
    RecordLengthImplausible = "record_length_implausible", Doubt;
    /// Bytes that are no record were skipped up to the next plausible record.
    UnreadableBytes = "unreadable_bytes", Loss;
    /// A record's fields run past its end.
    RecordMalformed = "record_malformed", Loss;
    /// A record lies where it must not, such as a chunk inside a chunk.
    UnexpectedRecord = "unexpected_record", Doubt;
    /// A record inside a chunk runs past the chunk's end.
    RecordOverrun = "record_overrun", Loss;
    /// The file ends inside a chunk; whole messages before the cut are kept.
    ChunkTruncated = "chunk_truncated", Loss;
    /// The CRC of a chunk differs; the chunk is dropped.
    ChunkCrcMismatch = "chunk_crc_mismatch", Loss;
    /// A chunk's uncompressed size differs from the one it states.
    ChunkSizeMismatch = "chunk_size_mismatch", Doubt;
    /// Messages lie outside the time span that their chunk states.
    ChunkTimeMismatch = "chunk_time_mismatch", Notice;
    /// A chunk names a compression that MCAP does not know; the chunk is dropped.
    UnsupportedCompression = "unsupported_compression", Loss;
    /// A chunk cannot be decompressed; whole messages before the bad place are kept.
    DecompressionFailed = "decompression_failed", Loss;
    /// A chunk or record is larger than the limits; it is dropped.
    SizeLimit = "size_limit", Loss;
    /// Messages refer to a channel that is defined nowhere; they are dropped.
    UnknownChannel = "unknown_channel", Loss;
    /// A channel refers to a schema that is defined nowhere.
    UnknownSchema = "unknown_schema", Doubt;
    /// One channel id has two different definitions; each message keeps the one in force where it lies.
    ChannelRedefined = "channel_redefined", Doubt;
    /// One schema id has two different definitions; each channel keeps the one in force where it lies.
    SchemaRedefined = "schema_redefined", Doubt;
    /// A channel is known only from a damaged chunk.
    DefinitionFromDamagedChunk = "definition_from_damaged_chunk", Doubt;
    /// An attachment's CRC differs.
    AttachmentCrcMismatch = "attachment_crc_mismatch", Doubt;
    /// The operating system failed to read a part of the file.
    ReadFailed = "read_failed", Loss;
    /// Messages have log time 0; they are left out of the file's time span.
    LogTimeZero = "log_time_zero", Notice;
}
