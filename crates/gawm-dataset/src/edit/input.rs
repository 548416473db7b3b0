//! A dataset that is read by an edit.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use gawm_schema::ContentHash;

use super::history::{self, EditRecord};
use super::{EditError, Piece};
use crate::episode::EpisodeRecord;
use crate::layout::{EDITS, EPISODES, GAWM};
use crate::provenance::GawmMeta;
use crate::read::{DType, Dataset, Defect, DefectKind, ReadLimits};
use crate::tables::read_episodes;

/// How a dataset is taken as an input.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct InputOptions {
    /// Leave out episodes that are damaged, instead of refusing the dataset.
    pub skips_damaged: bool,
    /// Leave out all cameras in video files.
    pub drops_videos: bool,
    /// Leave out these cameras.
    pub dropped_cameras: Vec<String>,
}

/// A dataset that is read by an edit.
#[derive(Debug)]
pub struct Input {
    /// The dataset.
    pub dataset: Dataset,
    /// What a gawm dataset says of itself; `None` for LeRobot folders.
    pub(super) gawm: Option<GawmInput>,
    /// Edits that it went through.
    pub(super) edits: Vec<EditRecord>,
    pub(super) hash: ContentHash,
    /// Runs that can be taken: whole episodes in readable files.
    usable: Vec<usize>,
    /// What is left out, for people.
    pub notes: Vec<String>,
    pub(super) options: InputOptions,
}

/// What a gawm dataset says of itself.
#[derive(Debug)]
pub(super) struct GawmInput {
    pub(super) meta: GawmMeta,
    pub(super) episodes: Vec<EpisodeRecord>,
}

impl Input {
    /// Opens a dataset for an edit.
    ///
    /// # Errors
    /// - the folder cannot be opened;
    /// - it is damaged in a way that an edit would hide, and damaged episodes are not to be left out.
    pub fn open(dir: &Path, options: InputOptions) -> Result<Input, EditError> {
        let dataset = Dataset::open(dir, ReadLimits::default())?;
        let mut notes = Vec::new();
        check_defects(&dataset, &options, &mut notes)?;
        check_cameras(&dataset, &options)?;
        let gawm = match &dataset.gawm {
            None => None,
            Some(value) => Some(read_gawm(&dataset, value)?),
        };
        let mut defects = Vec::new();
        let edits = crate::read::read_json(dir, EDITS, &dataset.limits, &mut defects);
        let edits = match defects.first() {
            Some(defect) => Err(defect.got.clone()),
            None => history::parse(edits),
        };
        let edits = edits.map_err(|got| damaged(&dataset, EDITS, "a list of edits", got))?;
        let usable = usable_runs(&dataset, &options, &mut notes)?;
        let hash = hash_of(&dataset, gawm.as_ref())?;
        Ok(Input { dataset, gawm, edits, hash, usable, notes, options })
    }

    /// Returns all whole episodes in reading order, as pieces of input number `input`.
    pub fn pieces(&self, input: usize) -> Vec<Piece> {
        let piece = |&run: &usize| Piece { input, run, rows: 0..self.dataset.runs[run].n_rows };
        self.usable.iter().map(piece).collect()
    }

    /// Returns the record of an episode of a gawm dataset.
    pub(super) fn record(&self, run: usize) -> Option<&EpisodeRecord> {
        let index = usize::try_from(self.dataset.runs[run].episode_index).ok()?;
        self.gawm.as_ref()?.episodes.get(index)
    }

    /// Returns the cameras in video files that are taken over.
    pub(super) fn videos(&self) -> Vec<String> {
        let features = self.dataset.info.features.iter();
        let videos = features.filter(|f| f.dtype == DType::Video && !self.is_dropped(f));
        videos.map(|f| f.name.clone()).collect()
    }

    /// Returns whether a feature is left out.
    pub(super) fn is_dropped(&self, feature: &crate::read::FeatureDecl) -> bool {
        (feature.dtype == DType::Video && self.options.drops_videos)
            || self.options.dropped_cameras.contains(&feature.name)
    }
}

fn damaged(dataset: &Dataset, place: &str, expected: &str, got: impl Into<String>) -> EditError {
    EditError::Damaged {
        path: dataset.root.clone(),
        place: place.to_owned(),
        expected: expected.to_owned(),
        got: got.into(),
    }
}

/// Only cameras of LeRobot folders can be left out: the schema of a gawm dataset is not changed.
fn check_cameras(dataset: &Dataset, options: &InputOptions) -> Result<(), EditError> {
    let cameras: Vec<&str> =
        dataset.info.features.iter().filter(|f| f.is_camera()).map(|f| f.name.as_str()).collect();
    for name in &options.dropped_cameras {
        if dataset.gawm.is_some() || !cameras.contains(&name.as_str()) {
            let expected = match dataset.gawm {
                Some(_) => "a LeRobot folder; the schema of a gawm dataset stays as it is".to_owned(),
                None => format!("one of {}", cameras.join(", ")),
            };
            return Err(EditError::Argument {
                what: "--without-camera".to_owned(),
                expected,
                got: name.clone(),
            });
        }
    }
    Ok(())
}

/// Refuses what an edit cannot repair by numbering anew; the rest is noted.
fn check_defects(
    dataset: &Dataset,
    options: &InputOptions,
    notes: &mut Vec<String>,
) -> Result<(), EditError> {
    for defect in &dataset.defects {
        let is_fatal = match defect.kind {
            DefectKind::UndeclaredColumn
            | DefectKind::MissingColumn
            | DefectKind::WrongType
            | DefectKind::BadFeature
            | DefectKind::UnsafePath
            | DefectKind::TooLarge => !is_bookkeeping(defect),
            // Files and episodes that cannot be read cost the episodes in them.
            DefectKind::UnreadableFile | DefectKind::MissingFile | DefectKind::BrokenRuns => {
                !options.skips_damaged && !is_only_order(defect)
            }
            DefectKind::BadMetadata => defect.place.starts_with(GAWM),
            // Counts, order and tables are written anew.
            _ => false,
        };
        if is_fatal {
            return Err(damaged(dataset, &defect.place, &defect.expected, defect.got.clone()));
        }
        if matches!(
            defect.kind,
            DefectKind::UnreadableFile
                | DefectKind::MissingFile
                | DefectKind::StrayFile
                | DefectKind::NullRows
        ) {
            notes.push(format!("{}: expected {}, got {}", defect.place, defect.expected, defect.got));
        }
    }
    Ok(())
}

/// Columns that are written anew may be missing or of another type.
fn is_bookkeeping(defect: &Defect) -> bool {
    let name = defect.place.strip_prefix("meta/info.json features.").unwrap_or(&defect.place);
    let is_ours = ["timestamp", "frame_index", "index"].contains(&name);
    // A note on names or on a slash does not hinder copying.
    is_ours || (defect.kind == DefectKind::BadFeature && !defect.expected.starts_with("a shape"))
}

/// Episodes that are whole, in another order or with gaps in their numbers, are numbered anew.
fn is_only_order(defect: &Defect) -> bool {
    defect.kind == DefectKind::BrokenRuns && !defect.got.ends_with("separate stretches")
}

fn read_gawm(dataset: &Dataset, value: &serde_json::Value) -> Result<GawmInput, EditError> {
    let meta: GawmMeta = serde_json::from_value(value.clone())
        .map_err(|error| damaged(dataset, GAWM, "a gawm description", error.to_string()))?;
    if meta.format_version != crate::layout::FORMAT_VERSION {
        let expected = format!("format version {}", crate::layout::FORMAT_VERSION);
        return Err(damaged(dataset, GAWM, &expected, meta.format_version.to_string()));
    }
    meta.schema.validate().map_err(|error| damaged(dataset, GAWM, "a possible schema", error.to_string()))?;
    let n_episodes = dataset.episodes.len();
    let path = crate::read::join_inside(&dataset.root, EPISODES)
        .map_err(|got| damaged(dataset, EPISODES, "a path inside the folder", got))?;
    let episodes =
        crate::read::guarded(|| read_episodes(&path, n_episodes).map_err(|error| error.to_string()))
            .map_err(|got| damaged(dataset, EPISODES, "an episode table of gawm", got))?;
    Ok(GawmInput { meta, episodes })
}

/// Returns the runs that are whole episodes; an episode in several stretches has no row order to trust.
fn usable_runs(
    dataset: &Dataset,
    options: &InputOptions,
    notes: &mut Vec<String>,
) -> Result<Vec<usize>, EditError> {
    let mut count: BTreeMap<i64, usize> = BTreeMap::new();
    dataset.runs.iter().for_each(|run| *count.entry(run.episode_index).or_default() += 1);
    let declared = |run: &crate::read::Run| {
        dataset.entry(run.episode_index).and_then(|e| e.length).is_none_or(|n| n == run.n_rows)
    };
    let mut usable = Vec::new();
    let mut left_out: BTreeMap<i64, &str> = BTreeMap::new();
    for (index, run) in dataset.runs.iter().enumerate() {
        if run.episode_index < 0 || count[&run.episode_index] > 1 {
            left_out.insert(run.episode_index, "its rows lie in several stretches");
        } else if !declared(run) && options.skips_damaged {
            left_out.insert(run.episode_index, "its rows are not as many as the episode table says");
        } else if run.n_rows > 0 {
            usable.push(index);
        }
    }
    let n_missing = dataset.episodes.iter().filter(|e| !count.contains_key(&e.episode_index)).count();
    if n_missing > 0 {
        notes.push(format!("{n_missing} episodes of the episode table have no rows and are left out"));
    }
    for (episode, reason) in left_out.iter().take(20) {
        notes.push(format!("episode {episode} is left out: {reason}"));
    }
    if left_out.len() > 20 {
        notes.push(format!("and {} more episodes are left out", left_out.len() - 20));
    }
    if usable.is_empty() {
        return Err(damaged(dataset, "data", "at least one whole episode", "none"));
    }
    Ok(usable)
}

fn hash_of(dataset: &Dataset, gawm: Option<&GawmInput>) -> Result<ContentHash, EditError> {
    let mut hasher = blake3::Hasher::new();
    if let Some(gawm) = gawm {
        gawm.episodes.iter().for_each(|episode| {
            hasher.update(&episode.content_hash.0);
        });
        return Ok(ContentHash(*hasher.finalize().as_bytes()));
    }
    for file in &dataset.files {
        let footer = read_footer(&file.path).map_err(EditError::io("read", &file.path))?;
        hasher.update(file.relative.as_bytes());
        hasher.update(&footer.0.to_le_bytes());
        hasher.update(&footer.1);
    }
    Ok(ContentHash(*hasher.finalize().as_bytes()))
}

/// Returns the length of a file and the bytes of its footer, at most 1 MiB of them.
fn read_footer(path: &Path) -> std::io::Result<(u64, Vec<u8>)> {
    let mut file = File::open(path)?;
    let length = file.metadata()?.len();
    let mut end = [0u8; 8];
    file.seek(SeekFrom::Start(length.saturating_sub(8)))?;
    let n_end = file.read(&mut end)?;
    let footer = u64::from(u32::from_le_bytes([end[0], end[1], end[2], end[3]])).min(1 << 20);
    file.seek(SeekFrom::Start(length.saturating_sub(footer + n_end as u64)))?;
    let mut bytes = Vec::new();
    file.take(footer + 8).read_to_end(&mut bytes)?;
    Ok((length, bytes))
}
