//! What was noticed about a file without refusing it.

use serde::Serialize;

/// One thing that the reader noticed: a loss, a doubt, or a part set aside.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What kind of thing.
    pub kind: FindingKind,
    /// Dataset, group, episode or file it concerns.
    pub place: String,
    /// What was expected and found.
    pub detail: String,
}

impl Finding {
    /// Makes a finding.
    pub fn new(kind: FindingKind, place: impl Into<String>, detail: impl Into<String>) -> Self {
        Self { kind, place: place.into(), detail: detail.into() }
    }
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {} ({})", self.place, self.detail, self.kind.name())
    }
}

/// Kinds of findings; the names in JSON are these in snake case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum FindingKind {
    /// The file is shorter than its own header says.
    Truncated,
    /// The writer did not close the file.
    UncleanClose,
    /// Rows that a killed writer, or a cut, left without their data.
    UnflushedRows,
    /// A group or dataset whose header cannot be read.
    BrokenObject,
    /// A group that is reachable twice; the second way is not followed.
    GroupLinkedTwice,
    /// A link into another file; it is not followed.
    ExternalLink,
    /// A dataset that cannot be read here (filter, type, virtual, external, pickled).
    UnreadableColumn,
    /// Rows after the last episode end: an episode that did not finish.
    UnfinishedTail,
    /// A column has more rows than its episode has steps (T+1 observations).
    ExtraRows,
    /// A column whose length fits neither the steps nor a constant.
    LengthMismatch,
    /// An episode that reaches beyond the rows that can be read.
    EpisodeCut,
    /// Two index columns contradict each other.
    InconsistentIndex,
    /// An episode with no rows.
    EmptyEpisode,
    /// An action array with a chunk of steps in every row.
    ChunkedAction,
    /// No array that looks like an action.
    NoAction,
    /// An end marker before the last row of an episode.
    EndInside,
}

impl FindingKind {
    /// The kind's name, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Truncated => "truncated",
            Self::UncleanClose => "unclean_close",
            Self::UnflushedRows => "unflushed_rows",
            Self::BrokenObject => "broken_object",
            Self::GroupLinkedTwice => "group_linked_twice",
            Self::ExternalLink => "external_link",
            Self::UnreadableColumn => "unreadable_column",
            Self::UnfinishedTail => "unfinished_tail",
            Self::ExtraRows => "extra_rows",
            Self::LengthMismatch => "length_mismatch",
            Self::EpisodeCut => "episode_cut",
            Self::InconsistentIndex => "inconsistent_index",
            Self::EmptyEpisode => "empty_episode",
            Self::ChunkedAction => "chunked_action",
            Self::NoAction => "no_action",
            Self::EndInside => "end_inside",
        }
    }

    /// Whether data that the file meant to hold is missing.
    pub fn is_loss(self) -> bool {
        matches!(
            self,
            Self::Truncated
                | Self::UnflushedRows
                | Self::BrokenObject
                | Self::UnreadableColumn
                | Self::EpisodeCut
        )
    }
}
