//! `[sim]`: what is collected, from a file, `--set` and options, in this order.

use std::path::{Path, PathBuf};

use gawm_schema::pipeline::{Override, OverrideError, SECTIONS, unknown_section};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::collect::{CollectOptions, ImageFormat};
use crate::two_room::{ExpertConfig, FRAME_SIZE, TwoRoomConfig};

/// Environments that can be collected from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum EnvironmentName {
    /// A dot that goes to a target, through the door of a wall
    #[default]
    TwoRoom,
}

/// How frames are stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ImageName {
    /// Lossless
    #[default]
    Png,
    /// Smaller; see --quality
    Jpeg,
}

/// The section `[sim]` of a pipeline, or a file of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimConfig {
    /// Environment.
    pub(super) env: EnvironmentName,
    /// Number of episodes; needed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) episodes: Option<u64>,
    /// Seed; needed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) seed: Option<u64>,
    /// Episodes in a log.
    pub(super) episodes_per_file: u64,
    /// How frames are stored.
    pub(super) image: ImageName,
    /// JPEG quality, 1 to 100.
    pub(super) quality: u8,
    /// Side of the stored frames in pixels, 8 to 4096.
    pub(super) size: u16,
    /// Longest episode, in steps of 0.1 s.
    pub(super) max_steps: u32,
    /// Standard deviation of the expert's noise on each action component.
    pub(super) action_noise: f64,
    /// Probability that the expert repeats its last action.
    pub(super) action_repeat: f64,
    /// Distance from a door's centre at which the expert turns to the target, in pixels.
    pub(super) door_reach_px: f32,
    /// The room.
    pub(super) room: TwoRoomConfig,
}

impl Default for SimConfig {
    fn default() -> Self {
        let expert = ExpertConfig::default();
        SimConfig {
            env: EnvironmentName::TwoRoom,
            episodes: None,
            seed: None,
            episodes_per_file: 50,
            image: ImageName::Png,
            quality: 95,
            size: FRAME_SIZE as u16,
            max_steps: 100,
            action_noise: expert.action_noise,
            action_repeat: expert.action_repeat,
            door_reach_px: expert.door_reach_px,
            room: TwoRoomConfig::default(),
        }
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SimConfigError {
    /// The file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The text is not TOML, or holds what it must not.
    #[error("{place}: {detail}")]
    Syntax {
        /// File or option.
        place: String,
        /// Why.
        detail: String,
    },
    /// An override does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// A value is missing or out of range.
    #[error("{key}: expected {expected}, got {got}")]
    Value {
        /// The key.
        key: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        got: String,
    },
}

impl SimConfig {
    /// Reads the file, if one is named, and applies overrides such as `max_steps=30` or `room.speed_px=4`.
    pub(super) fn load(path: Option<&Path>, overrides: &[String]) -> Result<SimConfig, SimConfigError> {
        let place = path.map_or_else(|| "--set".to_owned(), |path| path.display().to_string());
        let syntax = |detail: String| SimConfigError::Syntax { place: place.clone(), detail };
        let mut section = match path {
            Some(path) => {
                let text = std::fs::read_to_string(path)
                    .map_err(|source| SimConfigError::Read { path: path.to_owned(), source })?;
                let mut whole: toml::Table =
                    text.parse().map_err(|e: toml::de::Error| syntax(e.to_string()))?;
                if let Some(name) = whole.contains_key("sim").then(|| unknown_section(&whole)).flatten() {
                    return Err(syntax(format!("unknown section [{name}], expected one of {SECTIONS:?}")));
                }
                match whole.remove("sim") {
                    Some(toml::Value::Table(section)) => section,
                    Some(_) => return Err(syntax("expected [sim] to be a table".to_owned())),
                    None => whole,
                }
            }
            None => toml::Table::new(),
        };
        for text in overrides {
            Override::of_section("sim", text)?.apply(&mut section)?;
        }
        toml::Value::Table(section).try_into().map_err(|e: toml::de::Error| syntax(e.to_string()))
    }

    /// Returns the resolved configuration as TOML, in a section `[sim]`.
    pub(super) fn to_toml(&self) -> Result<String, SimConfigError> {
        #[derive(Serialize)]
        struct File<'a> {
            sim: &'a SimConfig,
        }
        toml::to_string(&File { sim: self })
            .map_err(|e| SimConfigError::Syntax { place: "configuration".to_owned(), detail: e.to_string() })
    }

    /// Checks ranges and returns the options of a collection.
    pub(super) fn options(&self, jobs: usize) -> Result<CollectOptions, SimConfigError> {
        let need = |key, expected, value: Option<u64>| {
            value.ok_or(SimConfigError::Value { key, expected, got: "nothing".to_owned() })
        };
        let check = |key, is_good: bool, expected, got: String| match is_good {
            true => Ok(()),
            false => Err(SimConfigError::Value { key, expected, got }),
        };
        check("quality", (1..=100).contains(&self.quality), "1 to 100", self.quality.to_string())?;
        check("size", (8..=4096).contains(&self.size), "8 to 4096", self.size.to_string())?;
        check(
            "max_steps",
            (1..=100_000).contains(&self.max_steps),
            "1 to 100000",
            self.max_steps.to_string(),
        )?;
        let noise = self.action_noise;
        check("action_noise", (0.0..=1e6).contains(&noise), "a number from 0 to 1e6", noise.to_string())?;
        let repeat = self.action_repeat;
        check("action_repeat", (0.0..=1.0).contains(&repeat), "a number from 0 to 1", repeat.to_string())?;
        let reach = self.door_reach_px;
        check("door_reach_px", (0.0..=224.0).contains(&reach), "0 to 224", reach.to_string())?;
        Ok(CollectOptions {
            room: self.room.clone(),
            expert: ExpertConfig { action_noise: noise, action_repeat: repeat, door_reach_px: reach },
            episodes: need("episodes", "a number (--episodes N)", self.episodes)?,
            seed: need("seed", "a number (--seed N)", self.seed)?,
            max_steps: self.max_steps,
            episodes_per_file: self.episodes_per_file,
            jobs,
            image: match self.image {
                ImageName::Png => ImageFormat::Png,
                ImageName::Jpeg => ImageFormat::Jpeg { quality: self.quality },
            },
            image_size: Some(self.size.into()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_refused(overrides: &[&str], expected: &str) {
        let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
        let error = SimConfig::load(None, &overrides).and_then(|config| config.options(1)).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }

    #[test]
    fn a_file_and_overrides_are_one_configuration() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.toml");
        std::fs::write(&path, "[sim]\nepisodes = 3\nseed = 1\n[sim.room]\nspeed_px = 4.0\n[train]\nx = 1\n")
            .unwrap();
        let overrides =
            ["sim.max_steps=30".to_owned(), "image=jpeg".to_owned(), "room.render_target=true".to_owned()];
        let config = SimConfig::load(Some(&path), &overrides).unwrap();
        assert_eq!((config.episodes, config.max_steps, config.image), (Some(3), 30, ImageName::Jpeg));
        assert!(config.room.render_target && config.room.speed_px == 4.0);
        std::fs::write(&path, config.to_toml().unwrap()).unwrap();
        assert_eq!(SimConfig::load(Some(&path), &[]).unwrap(), config, "what is printed reads back");
    }

    #[test]
    fn unusable_values_name_their_key() {
        check_refused(&["episodes=1"], "seed: expected a number (--seed N), got nothing");
        check_refused(&["episodes=1", "seed=1", "quality=0"], "quality: expected 1 to 100, got 0");
        check_refused(&["action_noise=nan", "episodes=1", "seed=1"], "action_noise");
        check_refused(&["sede=1"], "unknown field `sede`");
        check_refused(&["seed"], "expected key=value");
        check_refused(&["seed.x=1", "seed.y.z=2"], "seed");
    }
}
