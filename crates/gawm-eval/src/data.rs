//! Episodes of a dataset as evaluation needs them: states, actions, frames.

use std::path::{Path, PathBuf};

use gawm_dataset::layout::{ACTION, STATE};
use gawm_dataset::read::{Dataset, EpisodeRows, FrameBytes, OpenError, ReadLimits};
use gawm_image::{Image, ImageError, Limits, Pixels, decode, to_rgb8};
use gawm_schema::batch::EncodedFeature;
use gawm_sim::Frame;
use thiserror::Error;

/// One episode's numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Stable identifier.
    pub id: String,
    /// Position of its rows among the runs of the dataset.
    pub run_index: usize,
    /// `train` or `val`; empty when the dataset does not say.
    pub split: String,
    /// Encoded states in the order of the model, [rows, S] row-major, before standardisation.
    pub states: Vec<f64>,
    /// Encoded actions, [rows, A] row-major, before standardisation.
    pub actions: Vec<f64>,
    /// Whether the action of each row is one.
    pub action_valid: Vec<bool>,
    /// Raw system state, [rows, n] row-major.
    pub system: Vec<f64>,
    /// Number of rows.
    pub n_rows: usize,
}

/// A dataset, opened for evaluation.
#[derive(Debug)]
pub struct Data {
    dataset: Dataset,
    camera: String,
    /// The episodes, in the order of the dataset.
    pub episodes: Vec<Episode>,
}

/// Why a dataset cannot be evaluated on.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DataError {
    /// The folder cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// Rows cannot be read.
    #[error("dataset {path:?}: expected {expected}, got {got}")]
    Rows {
        /// The dataset.
        path: PathBuf,
        /// What was expected.
        expected: String,
        /// What is there.
        got: String,
    },
    /// The model was trained on a dimension that the dataset has not.
    #[error("dataset {path:?} has no dim {name:?} in {column}, which the model was trained on")]
    Dim {
        /// The dataset.
        path: PathBuf,
        /// The column.
        column: &'static str,
        /// The dim.
        name: String,
    },
    /// A frame is missing.
    #[error("no image of {camera} in row {row} of episode {episode}: expected one, got {got}")]
    MissingFrame {
        /// The camera.
        camera: String,
        /// The episode.
        episode: String,
        /// The row.
        row: usize,
        /// What is there.
        got: String,
    },
    /// A frame cannot be decoded.
    #[error("image of {camera} in row {row} of episode {episode}: {cause}")]
    Frame {
        /// The camera.
        camera: String,
        /// The episode.
        episode: String,
        /// The row.
        row: usize,
        /// The cause.
        cause: ImageError,
    },
}

impl Data {
    /// Opens a dataset and reads the numbers of all episodes.
    ///
    /// `state` and `action` are what the model was trained on (`hello.json`); `system` names the feature that holds the
    /// state of the environment.
    ///
    /// # Errors
    /// - [`DataError`] names the file, column or dim that is not as the model needs it.
    pub fn open(
        path: &Path,
        camera: &str,
        state: &EncodedFeature,
        action: &EncodedFeature,
        system: &str,
    ) -> Result<Data, DataError> {
        let dataset = Dataset::open(path, ReadLimits::default())?;
        let state_columns = positions(&dataset, STATE, state)?;
        let action_columns = positions(&dataset, ACTION, action)?;
        let valid = action_validity(&dataset);
        let mut names: Vec<String> = vec![STATE.to_owned(), ACTION.to_owned(), system.to_owned()];
        names.extend(valid.iter().cloned());
        names.dedup();
        let refuse = |expected: &str, got: String| DataError::Rows {
            path: path.to_owned(),
            expected: expected.to_owned(),
            got,
        };
        let read = |rows: EpisodeRows| {
            let entry = dataset.entry(rows.run.episode_index);
            let text = |name: &str| entry.and_then(|entry| entry.extra_text(name));
            let valid = valid.iter().filter_map(|name| rows.column(name));
            let mut action_valid = vec![true; rows.n_rows()];
            for column in valid {
                let bits = column.dims().first().map(Vec::as_slice).unwrap_or_default();
                action_valid.iter_mut().zip(bits).for_each(|(all, bit)| *all &= *bit != 0.0);
                let bits = column.ints().unwrap_or_default();
                action_valid.iter_mut().zip(bits).for_each(|(all, bit)| *all &= *bit != 0);
            }
            Episode {
                id: text("gawm/episode_id").unwrap_or_else(|| format!("episode-{}", rows.run.episode_index)),
                run_index: rows.run_index,
                split: text("split").unwrap_or_default(),
                states: select(&rows, STATE, &state_columns),
                actions: select(&rows, ACTION, &action_columns),
                action_valid,
                system: rows.column(system).map(|column| interleave(column.dims())).unwrap_or_default(),
                n_rows: rows.n_rows(),
            }
        };
        let (episodes, defects) =
            dataset.scan(&names, read).map_err(|error| refuse("readable rows", error.to_string()))?;
        if let Some(defect) = defects.first() {
            return Err(refuse(&defect.expected, format!("{} ({})", defect.got, defect.place)));
        }
        if episodes.is_empty() {
            return Err(refuse("at least one episode", "none".to_owned()));
        }
        if !dataset.image_columns().iter().any(|name| name == camera) {
            let got = format!("{:?}", dataset.image_columns());
            return Err(refuse(&format!("images of {camera}"), got));
        }
        Ok(Data { dataset, camera: camera.to_owned(), episodes })
    }

    /// Returns the hash of the dataset's schema, if it is a gawm dataset.
    pub fn schema_hash(&self) -> Option<String> {
        self.dataset.gawm.as_ref()?.get("schema_hash")?.as_str().map(str::to_owned)
    }

    /// Returns the positions of the held-out episodes; of all where the dataset does not hold out any.
    pub fn held_out(&self) -> (Vec<usize>, bool) {
        let of = |split: &str| -> Vec<usize> {
            (0..self.episodes.len()).filter(|&index| self.episodes[index].split == split).collect()
        };
        match of("val") {
            none if none.is_empty() => ((0..self.episodes.len()).collect(), false),
            held_out => (held_out, true),
        }
    }

    /// Reads frames of an episode; `rows` must be sorted.
    ///
    /// # Errors
    /// - [`DataError::MissingFrame`], [`DataError::Frame`], or the file cannot be read.
    pub fn frames(&self, episode: &Episode, rows: &[usize]) -> Result<Vec<Frame>, DataError> {
        let camera = &self.camera;
        let missing = |row: usize, got: &str| DataError::MissingFrame {
            camera: camera.clone(),
            episode: episode.id.clone(),
            row,
            got: got.to_owned(),
        };
        let bytes = self.dataset.read_frames(episode.run_index, camera, rows).map_err(|got| {
            DataError::Rows { path: self.dataset.root.clone(), expected: "readable frames".to_owned(), got }
        })?;
        if let Some(row) = rows.get(bytes.len()) {
            return Err(missing(*row, "fewer rows"));
        }
        rows.iter()
            .zip(bytes)
            .map(|(&row, bytes)| match bytes {
                FrameBytes::Encoded(bytes) => decode_rgb(&bytes).map_err(|cause| DataError::Frame {
                    camera: camera.clone(),
                    episode: episode.id.clone(),
                    row,
                    cause,
                }),
                FrameBytes::Absent => Err(missing(row, "nothing")),
                FrameBytes::Video(_) | FrameBytes::Undecodable(_) => Err(missing(row, "a frame of a video")),
                FrameBytes::TooLarge(size) => Err(missing(row, &format!("{size} bytes"))),
            })
            .collect()
    }
}

/// Decodes an image file to RGB.
fn decode_rgb(bytes: &[u8]) -> Result<Frame, ImageError> {
    let image: Image = to_rgb8(decode(bytes, &Limits::default())?)?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    match image.into_pixels() {
        Pixels::Rgb8(rgb) => Ok(Frame { width, height, rgb }),
        _ => Ok(Frame::default()),
    }
}

/// Positions of the model's dims within a continuous column.
fn positions(
    dataset: &Dataset,
    column: &'static str,
    wanted: &EncodedFeature,
) -> Result<Vec<usize>, DataError> {
    let declared = dataset.info.feature(column);
    let names: Vec<String> = declared
        .map(|feature| (0..feature.width()).map(|dim| feature.dim_name(dim)).collect())
        .unwrap_or_default();
    let position = |name: &str| {
        let found = names.iter().position(|have| have == name || (names.len() == 1 && have.is_empty()));
        found.ok_or_else(|| DataError::Dim { path: dataset.root.clone(), column, name: name.to_owned() })
    };
    wanted.dims.iter().map(|dim| position(&dim.name)).collect()
}

/// Columns that say whether actions are valid.
fn action_validity(dataset: &Dataset) -> Vec<String> {
    let features = dataset.schema.iter().flat_map(|schema| &schema.features);
    let actions = features.filter(|feature| feature.role == gawm_schema::Role::Action);
    actions.map(|feature| format!("gawm.valid.{}", feature.name)).collect()
}

fn select(rows: &EpisodeRows, column: &str, columns: &[usize]) -> Vec<f64> {
    let dims = rows.column(column).map(|column| column.dims()).unwrap_or_default();
    let chosen: Vec<Vec<f64>> = columns.iter().filter_map(|index| dims.get(*index).cloned()).collect();
    interleave(&chosen)
}

/// Turns one vector per dim into rows.
fn interleave(dims: &[Vec<f64>]) -> Vec<f64> {
    let n = dims.iter().map(Vec::len).min().unwrap_or(0);
    (0..n).flat_map(|row| dims.iter().map(move |dim| dim[row])).collect()
}
