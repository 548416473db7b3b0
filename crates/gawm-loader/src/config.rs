//! The section `[loader]` of a pipeline.

use std::path::PathBuf;

use gawm_schema::pipeline::{Override, OverrideError, SECTIONS, unknown_section};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How clips are made of datasets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LoaderConfig {
    /// `repaired` (default): clips span only the rows they use, the split is by episode, statistics are those of the
    /// training episodes. `reference`: as published (span `frames * frameskip`, split by clip, statistics of all rows).
    pub compat: Compat,
    /// Rows between two frames of a clip, and actions in a chunk. Default 5.
    pub frameskip: usize,
    /// Frames of a clip that are given. Default 3.
    pub history: usize,
    /// Frames of a clip that are predicted. Default 1.
    pub predicted: usize,
    /// Clips of a batch. Default 128.
    pub batch: usize,
    /// Height and width of frames in pixels; frames of other sizes are resized. Default: as in the dataset.
    pub image_size: Option<[usize; 2]>,
    /// Cameras, in order. Default: all colour cameras of the dataset.
    pub cameras: Vec<String>,
    /// State features whose dims are loaded, in the dataset's order. Default: all.
    pub state_features: Vec<String>,
    /// What is held out: `dataset` (the column `split` of the episode table) or `clip` (10 % of clips at random, as
    /// published). Default: `dataset`, with `compat = "reference"` `clip`.
    pub split: Option<SplitRule>,
    /// Seed of the order of clips. Default 3072.
    pub seed: u64,
    /// Loader processes. Default 1.
    pub loaders: u32,
    /// Batches that a loader may have made before the trainer takes them, the one being made included. Default 3.
    pub slots: usize,
    /// Threads of a loader that decode. Default 1.
    pub threads: usize,
    /// Keep all frames decoded in a file that the loaders map. Default false.
    pub cache: bool,
    /// Largest cache file in GiB; a larger one is refused. Default 16.
    pub cache_budget_gib: f64,
    /// Folder of the cache file. Default: `gawm/cache` in the first dataset.
    pub cache_dir: Option<PathBuf>,
    /// Further datasets to draw clips from, beside the one given with `--data`.
    pub mix: Vec<MixEntry>,
    /// How often each clip of the dataset given with `--data` is drawn, relative to `mix`. Default 1.
    pub weight: f64,
}

/// A further dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MixEntry {
    /// Its folder.
    pub data: PathBuf,
    /// How often each of its clips is drawn, relative to the others. Default 1.
    #[serde(default = "one")]
    pub weight: f64,
}

fn one() -> f64 {
    1.0
}

/// Whose semantics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Compat {
    /// Ours.
    #[default]
    Repaired,
    /// As published, to the bit.
    Reference,
}

/// What is held out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum SplitRule {
    /// Episodes that the dataset marks.
    Dataset,
    /// Single clips.
    Clip,
}

impl Default for LoaderConfig {
    fn default() -> Self {
        LoaderConfig {
            compat: Compat::Repaired,
            frameskip: 5,
            history: 3,
            predicted: 1,
            batch: 128,
            image_size: None,
            cameras: Vec::new(),
            state_features: Vec::new(),
            split: None,
            seed: 3072,
            loaders: 1,
            slots: 3,
            threads: 1,
            cache: false,
            cache_budget_gib: 16.0,
            cache_dir: None,
            mix: Vec::new(),
            weight: 1.0,
        }
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// It is not TOML, or a field is unknown or of the wrong type.
    #[error("{reason}")]
    Syntax {
        /// What the parser said, with the place.
        reason: String,
    },
    /// It has a section that no program reads.
    #[error("unknown section [{name}]: expected one of {}", SECTIONS.join(", "))]
    Section {
        /// The name.
        name: String,
    },
    /// A `--set` does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// A number is out of range.
    #[error("unusable [loader] {field}: expected {expected}, got {got}")]
    Range {
        /// The field.
        field: &'static str,
        /// What is possible.
        expected: &'static str,
        /// The value.
        got: String,
    },
}

impl LoaderConfig {
    /// Reads the section `[loader]` of a pipeline and applies settings of the form `loader.field=value`.
    ///
    /// A pipeline without the section has all defaults.
    ///
    /// # Errors
    /// [`ConfigError`] for the first thing that is wrong.
    pub fn from_pipeline(text: &str, settings: &[String]) -> Result<LoaderConfig, ConfigError> {
        let syntax = |error: toml::de::Error| ConfigError::Syntax { reason: error.to_string() };
        let mut pipeline: toml::Table = toml::from_str(text).map_err(syntax)?;
        if let Some(name) = unknown_section(&pipeline) {
            return Err(ConfigError::Section { name: name.to_owned() });
        }
        for setting in settings {
            Override::of_pipeline(setting)?.apply(&mut pipeline)?;
        }
        let section = pipeline.remove("loader").unwrap_or_else(|| toml::Value::Table(toml::Table::new()));
        let config: LoaderConfig = section.try_into().map_err(syntax)?;
        config.check()?;
        Ok(config)
    }

    /// Returns the frames of a clip.
    pub fn frames(&self) -> usize {
        self.history + self.predicted
    }

    /// Returns the rows that a clip takes.
    pub fn span(&self) -> usize {
        match self.compat {
            Compat::Repaired => (self.frames() - 1) * self.frameskip + 1,
            Compat::Reference => self.frames() * self.frameskip,
        }
    }

    /// Returns the rows whose actions a clip needs.
    pub(crate) fn action_rows(&self) -> usize {
        (self.frames() - 1) * self.frameskip
    }

    /// Returns the split rule in force.
    pub fn split_rule(&self) -> SplitRule {
        self.split.unwrap_or(match self.compat {
            Compat::Repaired => SplitRule::Dataset,
            Compat::Reference => SplitRule::Clip,
        })
    }

    /// Checks the ranges of all fields.
    ///
    /// # Errors
    /// [`ConfigError::Range`] for the first that is out of range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let within = |field, got: usize, least: usize, most: usize, expected| {
            if (least..=most).contains(&got) {
                return Ok(());
            }
            Err(ConfigError::Range { field, expected, got: got.to_string() })
        };
        within("frameskip", self.frameskip, 1, 1000, "1 to 1000")?;
        within("history", self.history, 1, 1000, "1 to 1000")?;
        within("predicted", self.predicted, 1, 1000, "1 to 1000")?;
        within("batch", self.batch, 1, 1 << 20, "1 to 1048576")?;
        within("loaders", self.loaders as usize, 1, 1024, "1 to 1024")?;
        within("slots", self.slots, 1, gawm_shm::MAX_SLOTS, "1 to 16")?;
        within("threads", self.threads, 1, 1024, "1 to 1024")?;
        within("mix", self.mix.len(), 0, 1 << 15, "at most 32768 datasets")?;
        for side in self.image_size.into_iter().flatten() {
            within("image_size", side, 1, 1 << 15, "sides of 1 to 32768 pixels")?;
        }
        let weights = self.mix.iter().map(|entry| entry.weight).chain([self.weight]);
        let is_weight = |weight: f64| weight.is_finite() && (0.0..=1e6).contains(&weight);
        for weight in weights {
            if !is_weight(weight) {
                let got = weight.to_string();
                return Err(ConfigError::Range { field: "weight", expected: "0 to 1000000", got });
            }
        }
        if !(self.cache_budget_gib >= 0.0 && self.cache_budget_gib.is_finite()) {
            let got = self.cache_budget_gib.to_string();
            return Err(ConfigError::Range { field: "cache_budget_gib", expected: "0 or more", got });
        }
        Ok(())
    }

    /// Returns the section as TOML, defaults included.
    pub fn to_toml(&self) -> String {
        #[derive(Serialize)]
        struct Pipeline<'a> {
            loader: &'a LoaderConfig,
        }
        toml::to_string(&Pipeline { loader: self }).expect("numbers, texts and lists of them are TOML")
    }
}
