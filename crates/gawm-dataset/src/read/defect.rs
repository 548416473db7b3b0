//! What is wrong with a folder, found while reading it.

/// The kind of an inconsistency; each maps to one rule code of `gawm-data validate`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum DefectKind {
    /// A required key of `meta/info.json` is missing or has the wrong type.
    InfoKey,
    /// A metadata file is missing or does not parse.
    BadMetadata,
    /// A path from metadata leaves the folder, or a link does.
    UnsafePath,
    /// A file that metadata name does not exist.
    MissingFile,
    /// A Parquet file cannot be read.
    UnreadableFile,
    /// A Parquet file that no metadata name lies where readers glob.
    StrayFile,
    /// A declared feature has no column.
    MissingColumn,
    /// A column is not declared.
    UndeclaredColumn,
    /// A column's type cannot be read as the declared one.
    WrongType,
    /// Rows hold null.
    NullRows,
    /// Rows hold lists of another length than declared.
    WrongWidth,
    /// The rows of an episode are not contiguous, or episodes are out of order.
    BrokenRuns,
    /// A count in `meta/info.json` differs from the data.
    WrongCount,
    /// The episode table disagrees with the data.
    EpisodeTable,
    /// The task table is inconsistent.
    TaskTable,
    /// A feature declaration is unusable.
    BadFeature,
    /// The folder exceeds a bound of [`ReadLimits`](super::ReadLimits).
    TooLarge,
}

/// One inconsistency met while reading.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Defect {
    /// What kind it is.
    pub kind: DefectKind,
    /// The episode it concerns, if one.
    pub episode: Option<i64>,
    /// File, key or column, relative to the dataset folder.
    pub place: String,
    /// What a sound dataset has there.
    pub expected: String,
    /// What was found.
    pub got: String,
}

impl Defect {
    /// Returns a defect that concerns the whole dataset.
    pub fn new(
        kind: DefectKind,
        place: impl Into<String>,
        expected: impl Into<String>,
        got: impl Into<String>,
    ) -> Defect {
        Defect { kind, episode: None, place: place.into(), expected: expected.into(), got: got.into() }
    }

    /// Returns the defect, concerning one episode.
    #[must_use]
    pub fn in_episode(mut self, episode: i64) -> Defect {
        self.episode = Some(episode);
        self
    }
}
