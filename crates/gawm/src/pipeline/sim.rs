//! `[sim]`: what a pipeline lets a simulator record.

use std::ffi::OsString;

use serde::{Deserialize, Serialize};

/// Options of `gawm-sim collect`, as a section of a pipeline.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SimSection {
    /// Environment, as `gawm-sim collect --env` names it.
    pub env: String,
    /// Number of episodes.
    pub episodes: u64,
    /// Seed: the same seed and options give the same bytes.
    pub seed: u64,
    /// Side of the stored frames in pixels; by default that of `gawm-sim collect`.
    pub size: Option<u16>,
    /// `png` (lossless, the default) or `jpeg`.
    pub image: Option<String>,
    /// JPEG quality, 1 to 100.
    pub quality: Option<u8>,
    /// Longest episode in steps.
    pub max_steps: Option<u32>,
    /// Standard deviation of the expert's noise on each action component.
    pub action_noise: Option<f64>,
    /// Probability that the expert repeats its last action.
    pub action_repeat: Option<f64>,
    /// Episodes in one log.
    pub episodes_per_file: Option<u64>,
}

impl SimSection {
    /// Returns the arguments of `gawm-sim` that collect this.
    pub fn arguments(&self) -> Vec<OsString> {
        let mut arguments: Vec<OsString> = vec!["collect".into()];
        let mut push = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                arguments.push(name.into());
                arguments.push(value.into());
            }
        };
        push("--env", Some(self.env.clone()));
        push("--episodes", Some(self.episodes.to_string()));
        push("--seed", Some(self.seed.to_string()));
        push("--size", self.size.map(|value| value.to_string()));
        push("--image", self.image.clone());
        push("--quality", self.quality.map(|value| value.to_string()));
        push("--max-steps", self.max_steps.map(|value| value.to_string()));
        push("--action-noise", self.action_noise.map(|value| value.to_string()));
        push("--action-repeat", self.action_repeat.map(|value| value.to_string()));
        push("--episodes-per-file", self.episodes_per_file.map(|value| value.to_string()));
        arguments
    }
}
