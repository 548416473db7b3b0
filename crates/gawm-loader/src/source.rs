//! One dataset, opened for drawing clips.

use std::path::{Path, PathBuf};

use gawm_dataset::GawmMeta;
use gawm_dataset::layout::{ACTION, FORMAT_VERSION, STATE, VALID};
use gawm_dataset::read::{Dataset, DefectKind, ReadLimits};
use gawm_schema::{ContentHash, EncodedDim, FeatureData, ImageSpec, Role, Standardisation};

use crate::config::LoaderConfig;
use crate::error::LoadError;
use crate::frames::FrameFiles;
use crate::rows::{self, Columns, Rows};

/// One dataset: what it is, its rows in memory, its frames by position.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) path: PathBuf,
    pub(crate) cameras: Vec<Camera>,
    pub(crate) state: Encoded,
    pub(crate) action: Encoded,
    pub(crate) rate_hz: f64,
    pub(crate) schema_hash: ContentHash,
    /// Hash over the content hashes of the episodes, in order.
    pub(crate) content_hash: ContentHash,
    pub(crate) episodes: Vec<Episode>,
    pub(crate) rows: Rows,
    pub(crate) frames: FrameFiles,
}

/// A camera in use.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Camera {
    pub(crate) name: String,
    pub(crate) spec: ImageSpec,
}

/// A continuous column: its dims in use and how the dataset standardises them.
#[derive(Debug, Clone)]
pub(crate) struct Encoded {
    pub(crate) dims: Vec<EncodedDim>,
    pub(crate) standardisation: Option<Standardisation>,
}

/// A stretch of rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Episode {
    /// Its first row in the dataset.
    pub(crate) first_row: u64,
    /// Its rows.
    pub(crate) rows: usize,
    /// Whether the dataset counts it as training data.
    pub(crate) is_training: bool,
}

impl Source {
    /// Opens a finished gawm dataset and reads its numbers.
    pub(crate) fn open(path: &Path, config: &LoaderConfig) -> Result<Source, LoadError> {
        let dataset = Dataset::open(path, ReadLimits::default())?;
        let meta = meta(&dataset)?;
        let cameras = cameras(path, &meta, &config.cameras)?;
        let mut state = encoded(&meta, STATE);
        let features = state_features(path, &meta, &config.state_features)?;
        let kept: Vec<usize> = (0..state.dims.len())
            .filter(|i| features.as_ref().is_none_or(|names| names.contains(&state.dims[*i].feature)))
            .collect();
        let all_state_dims = state.dims.len();
        state = subset(&state, &kept);
        let action = encoded(&meta, ACTION);
        if action.dims.is_empty() {
            return Err(LoadError::dataset(path, "an action feature", "none in meta/gawm.json"));
        }
        let episodes = episodes(&dataset)?;
        let columns = Columns {
            state_dims: all_state_dims,
            kept,
            state_features: state.dims.iter().map(|d| d.feature.clone()).collect(),
            action_dims: action.dims.len(),
            action_features: features_of(&action.dims),
            cameras: cameras.iter().map(|c| c.name.clone()).collect(),
        };
        let rows = rows::read(&dataset, &columns)?;
        let frames = FrameFiles::open(&dataset, &columns.cameras)?;
        let hashes = dataset.episodes.iter().map(|e| e.extra_text("gawm/content_hash").unwrap_or_default());
        let content_hash = ContentHash::of(hashes.collect::<Vec<_>>().join("\n").as_bytes());
        let (rate_hz, schema_hash) = (meta.rate_hz, meta.schema_hash);
        let path = path.to_owned();
        Ok(Source {
            path,
            cameras,
            state,
            action,
            rate_hz,
            schema_hash,
            content_hash,
            episodes,
            rows,
            frames,
        })
    }

    /// Returns the number of rows.
    pub(crate) fn n_rows(&self) -> u64 {
        self.rows.len() as u64
    }
}

fn meta(dataset: &Dataset) -> Result<GawmMeta, LoadError> {
    let path = &dataset.root;
    let Some(value) = &dataset.gawm else {
        let got = "none: a LeRobot dataset without gawm's columns";
        return Err(LoadError::dataset(path, "meta/gawm.json", got));
    };
    let version = value.get("format_version").and_then(serde_json::Value::as_u64);
    if version != Some(u64::from(FORMAT_VERSION)) {
        let got = version.map_or("none".to_owned(), |v| v.to_string());
        return Err(LoadError::dataset(path, format!("format version {FORMAT_VERSION}"), got));
    }
    let meta: GawmMeta = serde_json::from_value(value.clone())
        .map_err(|e| LoadError::dataset(path, "a readable meta/gawm.json", e.to_string()))?;
    // What only makes a table disagree is for `validate`; rows that cannot be read are not.
    let fatal = [
        DefectKind::UnreadableFile,
        DefectKind::MissingFile,
        DefectKind::UnsafePath,
        DefectKind::StrayFile,
        DefectKind::MissingColumn,
        DefectKind::WrongType,
    ];
    if let Some(defect) = dataset.defects.iter().find(|d| fatal.contains(&d.kind)) {
        let got = format!("{} ({})", defect.got, defect.place);
        return Err(LoadError::dataset(path, defect.expected.clone(), got));
    }
    Ok(meta)
}

fn cameras(path: &Path, meta: &GawmMeta, wanted: &[String]) -> Result<Vec<Camera>, LoadError> {
    let mut all = Vec::new();
    for feature in &meta.schema.features {
        if let FeatureData::Image(spec) = &feature.data {
            all.push(Camera { name: feature.name.clone(), spec: spec.clone() });
        }
    }
    let names = |cameras: &[Camera]| cameras.iter().map(|c| c.name.clone()).collect::<Vec<_>>().join(", ");
    let chosen: Vec<Camera> = if wanted.is_empty() {
        all.iter().filter(|c| !c.spec.depth).cloned().collect()
    } else {
        let find = |name: &String| {
            let camera = all.iter().find(|c| c.name == *name).cloned();
            camera.ok_or_else(|| LoadError::dataset(path, format!("a camera {name:?}"), names(&all)))
        };
        wanted.iter().map(find).collect::<Result<_, _>>()?
    };
    if let Some(camera) = chosen.iter().find(|c| c.spec.depth) {
        return Err(LoadError::dataset(path, "colour cameras", format!("{:?}, which is depth", camera.name)));
    }
    if chosen.is_empty() {
        return Err(LoadError::dataset(path, "at least one colour camera", "none"));
    }
    Ok(chosen)
}

/// Returns the chosen state features, checked; `None` for all.
fn state_features(path: &Path, meta: &GawmMeta, wanted: &[String]) -> Result<Option<Vec<String>>, LoadError> {
    if wanted.is_empty() {
        return Ok(None);
    }
    let states = meta.schema.features.iter().filter(|f| f.role == Role::State).map(|f| f.name.clone());
    let states: Vec<String> = states.collect();
    match wanted.iter().find(|name| !states.contains(name)) {
        Some(name) => Err(LoadError::dataset(path, format!("a state feature {name:?}"), states.join(", "))),
        None => Ok(Some(wanted.to_vec())),
    }
}

fn encoded(meta: &GawmMeta, column: &str) -> Encoded {
    let dims = meta.encodings.get(column).cloned().unwrap_or_default();
    let standardisation = meta.standardisation.iter().find(|s| s.column == column);
    let standardisation = standardisation.filter(|s| s.dims.len() == dims.len()).cloned();
    Encoded { dims, standardisation }
}

fn subset(encoded: &Encoded, kept: &[usize]) -> Encoded {
    let dims = kept.iter().map(|i| encoded.dims[*i].clone()).collect();
    let standardisation = encoded
        .standardisation
        .clone()
        .map(|s| Standardisation { dims: kept.iter().map(|i| s.dims[*i].clone()).collect(), ..s });
    Encoded { dims, standardisation }
}

fn features_of(dims: &[EncodedDim]) -> Vec<String> {
    let mut names: Vec<String> = dims.iter().map(|d| d.feature.clone()).collect();
    names.dedup();
    names
}

/// Lists the episodes; in a gawm dataset each is one run of rows, in order.
fn episodes(dataset: &Dataset) -> Result<Vec<Episode>, LoadError> {
    let path = &dataset.root;
    let (runs, table) = (&dataset.runs, &dataset.episodes);
    if runs.len() != table.len() {
        let expected = format!("{} episodes as in the episode table", table.len());
        return Err(LoadError::dataset(path, expected, format!("{} in the data files", runs.len())));
    }
    let mut episodes = Vec::with_capacity(runs.len());
    for (run, entry) in runs.iter().zip(table) {
        let is_same = run.episode_index == entry.episode_index && entry.length == Some(run.n_rows);
        let Ok(rows) = usize::try_from(run.n_rows) else {
            return Err(LoadError::dataset(path, "fewer rows", run.n_rows.to_string()));
        };
        if !is_same {
            let expected = format!(
                "episode {} of {} rows as in the episode table",
                entry.episode_index,
                entry.length.unwrap_or(0)
            );
            let got = format!("episode {} of {} rows", run.episode_index, run.n_rows);
            return Err(LoadError::dataset(path, expected, got));
        }
        let is_training = match entry.extra_text("split").as_deref() {
            Some("train") => true,
            Some("val") => false,
            other => {
                let got = other.unwrap_or("nothing").to_owned();
                return Err(LoadError::dataset(path, "split train or val in meta/episodes", got));
            }
        };
        episodes.push(Episode { first_row: run.global_start, rows, is_training });
    }
    Ok(episodes)
}

/// Returns the name of the validity column of a feature.
pub(crate) fn validity(feature: &str) -> String {
    format!("{VALID}{feature}")
}
