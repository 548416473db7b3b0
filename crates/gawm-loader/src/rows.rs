//! The numbers of all rows of a dataset, in memory.
//!
//! A row takes `4 * (S + A) + S + 1 + V` bytes: 2 million rows of a small robot are some 60 MB per loader. Reading them
//! from disk per clip would cost a decompressed page for every handful of numbers.

use std::ops::Range;

use gawm_dataset::layout::{ACTION, STATE};
use gawm_dataset::read::{Dataset, EpisodeRows};

use crate::error::LoadError;
use crate::source::validity;

/// Most rows of a dataset; clip ids have 48 bits for a row, clip lists 32 bits for a clip.
const MAX_ROWS: u64 = u32::MAX as u64;

/// What is read.
#[derive(Debug)]
pub(crate) struct Columns {
    /// Dims of `gawm.state` in the files.
    pub(crate) state_dims: usize,
    /// Positions of those in use.
    pub(crate) kept: Vec<usize>,
    /// The feature of each state dim in use.
    pub(crate) state_features: Vec<String>,
    /// Dims of `gawm.action`.
    pub(crate) action_dims: usize,
    /// The features that actions come from.
    pub(crate) action_features: Vec<String>,
    /// The cameras in use.
    pub(crate) cameras: Vec<String>,
}

/// Numbers and validity of all rows; row-major.
#[derive(Debug, Default)]
pub(crate) struct Rows {
    len: usize,
    /// Shape [rows, S]; raw until standardised.
    pub(crate) states: Vec<f32>,
    /// Shape [rows, S].
    pub(crate) state_valid: Vec<u8>,
    /// Shape [rows, A]; raw until standardised.
    pub(crate) actions: Vec<f32>,
    /// Shape [rows].
    pub(crate) action_valid: Vec<u8>,
    /// Shape [rows, V].
    pub(crate) frame_valid: Vec<u8>,
}

impl Rows {
    /// Returns the number of rows.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Returns whether all frames of a row are valid.
    pub(crate) fn is_frame_valid(&self, row: usize, views: usize) -> bool {
        self.frame_valid[row * views..][..views].iter().all(|v| *v != 0)
    }

    /// Returns whether the actions of all rows of a range are valid.
    pub(crate) fn are_actions_valid(&self, rows: Range<usize>) -> bool {
        self.action_valid[rows].iter().all(|v| *v != 0)
    }

    fn append(&mut self, other: Rows) {
        self.len += other.len;
        self.states.extend(other.states);
        self.state_valid.extend(other.state_valid);
        self.actions.extend(other.actions);
        self.action_valid.extend(other.action_valid);
        self.frame_valid.extend(other.frame_valid);
    }
}

/// Reads the rows of a dataset.
pub(crate) fn read(dataset: &Dataset, columns: &Columns) -> Result<Rows, LoadError> {
    let path = &dataset.root;
    if dataset.n_rows() > MAX_ROWS {
        return Err(LoadError::dataset(
            path,
            format!("at most {MAX_ROWS} rows"),
            dataset.n_rows().to_string(),
        ));
    }
    let features = columns.state_features.iter().chain(&columns.action_features).chain(&columns.cameras);
    let mut names: Vec<String> = features.map(|feature| validity(feature)).collect();
    names.sort();
    names.dedup();
    names.extend([STATE.to_owned(), ACTION.to_owned()]);
    let scanned = dataset.scan(&names, |rows| episode(&rows, columns));
    let (episodes, defects) =
        scanned.map_err(|e| LoadError::dataset(path, "readable rows", e.to_string()))?;
    if let Some(defect) = defects.first() {
        let got = format!("{} ({})", defect.got, defect.place);
        return Err(LoadError::dataset(path, defect.expected.clone(), got));
    }
    let mut rows = Rows::default();
    for episode in episodes {
        rows.append(episode.map_err(|(expected, got)| LoadError::dataset(path, expected, got))?);
    }
    if rows.len as u64 != dataset.n_rows() {
        let expected = format!("{} rows", dataset.n_rows());
        return Err(LoadError::dataset(path, expected, format!("{} readable ones", rows.len)));
    }
    Ok(rows)
}

/// Turns the columns of an episode into rows, or says (expected, got).
fn episode(source: &EpisodeRows, columns: &Columns) -> Result<Rows, (String, String)> {
    let n = source.n_rows();
    let vector = |name: &str, width: usize| -> Result<Vec<&[f64]>, (String, String)> {
        let column = source.column(name).ok_or_else(|| (format!("column {name}"), "none".to_owned()))?;
        let dims: Vec<&[f64]> = column.dims().iter().map(Vec::as_slice).collect();
        let is_whole = dims.len() == width
            && dims.iter().all(|d| d.len() == n)
            && column.nulls.n_rows + column.wrong_widths.n_rows == 0;
        if is_whole {
            return Ok(dims);
        }
        let expected = format!("column {name} with {width} values in each of {n} rows");
        Err((expected, format!("{} of episode {}", dims.len(), source.run.episode_index)))
    };
    let mut rows = Rows { len: n, ..Rows::default() };
    if !columns.kept.is_empty() {
        let dims = vector(STATE, columns.state_dims)?;
        let mut valid = Vec::new();
        for feature in &columns.state_features {
            valid.extend(vector(&validity(feature), 1)?);
        }
        for row in 0..n {
            for (position, valid) in columns.kept.iter().zip(&valid) {
                let value = dims[*position][row] as f32;
                rows.states.push(value);
                rows.state_valid.push(u8::from(valid[row] != 0.0 && value.is_finite()));
            }
        }
    }
    let actions = vector(ACTION, columns.action_dims)?;
    let mut flags = Vec::new();
    for feature in &columns.action_features {
        flags.extend(vector(&validity(feature), 1)?);
    }
    for row in 0..n {
        rows.actions.extend(actions.iter().map(|dim| dim[row] as f32));
        let is_valid =
            flags.iter().all(|f| f[row] != 0.0) && actions.iter().all(|dim| (dim[row] as f32).is_finite());
        rows.action_valid.push(u8::from(is_valid));
    }
    let mut frames = Vec::new();
    for camera in &columns.cameras {
        frames.extend(vector(&validity(camera), 1)?);
    }
    for row in 0..n {
        rows.frame_valid.extend(frames.iter().map(|valid| u8::from(valid[row] != 0.0)));
    }
    Ok(rows)
}
