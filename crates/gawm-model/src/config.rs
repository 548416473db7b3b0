//! Sizes of a model: what a user writes ([`ModelConfig`]) and what is checked ([`Architecture`]).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Names of the presets of [`ModelConfig::preset`].
///
/// `tiny-14` is the published model (ViT-Tiny/14 at 224 px, 18.0 million parameters with the predictor), `nano` is one
/// for machines without a GPU (64 px, patch 8, width 64, depth 4), `micro` is for tests.
pub const PRESETS: [&str; 3] = ["tiny-14", "nano", "micro"];

/// Sizes of a model as written in a configuration; the default is `tiny-14`, the published model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ModelConfig {
    /// Side of the frames in pixels that the position table is made for; other sizes are interpolated.
    pub image_size: usize,
    /// The frame encoder.
    pub encoder: EncoderConfig,
    /// Width `D` of a latent.
    pub latent_width: usize,
    /// Hidden width of the two projectors.
    pub projector_width: usize,
    /// Width of the first, linear layer of the action embedder. The published value 10 makes wider chunks pass a
    /// bottleneck of rank 10.
    pub action_bottleneck: usize,
    /// Use `max(action_bottleneck, A)` as the width of that layer; off as published.
    pub widen_action_bottleneck: bool,
    /// The predictor.
    pub predictor: PredictorConfig,
    /// Hidden width of the state head G.
    pub state_head_width: usize,
    /// Hidden width of the inverse dynamics head H.
    pub inverse_head_width: usize,
    /// What the inverse dynamics head sees.
    pub inverse_input: InverseInput,
    /// Build the head G, if the data has states.
    pub state_head: bool,
    /// Build the head H.
    pub inverse_head: bool,
}

/// Sizes of the vision transformer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EncoderConfig {
    /// Side of a patch in pixels.
    pub patch_size: usize,
    /// Width `W` of a token.
    pub width: usize,
    /// Number of layers.
    pub depth: usize,
    /// Number of attention heads; divides the width.
    pub heads: usize,
    /// Hidden width of the MLPs.
    pub mlp_width: usize,
}

/// Sizes of the predictor; its tokens have the width of a latent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PredictorConfig {
    /// Number of frames it sees at once; a clip has one more.
    pub history: usize,
    /// Number of blocks.
    pub depth: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Width of an attention head.
    pub head_width: usize,
    /// Hidden width of the MLPs.
    pub mlp_width: usize,
    /// Dropout rate in attention and MLPs, in [0, 1).
    pub dropout: f64,
}

/// What the inverse dynamics head sees of two consecutive latents.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum InverseInput {
    /// `concat(z[t], z[t+1])`, as published.
    Pair,
    /// `concat(z[t+1], z[t])`, the order of PLDM.
    PairReversed,
    /// `z[t+1] - z[t]` (Delta-JEPA).
    Difference,
}

/// Widths that the data fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct DataWidths {
    /// Width `A` of an action chunk: frameskip times the raw action width.
    pub action: usize,
    /// Width `S` of a state target; 0 if the data has none.
    pub state: usize,
}

/// Checked sizes of a model: everything that decides which parameters exist and what shapes they have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    config: ModelConfig,
    widths: DataWidths,
}

/// Why sizes cannot make a model.
#[derive(Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum ConfigError {
    /// No preset has this name.
    #[error("unknown model preset {name:?}: expected one of {PRESETS:?}")]
    UnknownPreset {
        /// The name given.
        name: String,
    },
    /// The text is not a model configuration.
    #[error("model configuration: {message}")]
    Syntax {
        /// What the parser says, with the place.
        message: String,
    },
    /// A size is out of range.
    #[error("{field}: expected {minimum} to {maximum}, got {got}")]
    Range {
        /// The field's path.
        field: &'static str,
        /// Smallest value allowed.
        minimum: usize,
        /// Largest value allowed.
        maximum: usize,
        /// The value given.
        got: usize,
    },
    /// The width does not divide into heads.
    #[error("encoder.width {width} is not a multiple of encoder.heads {heads}")]
    Heads {
        /// Width of a token.
        width: usize,
        /// Number of heads.
        heads: usize,
    },
    /// The dropout rate is out of range.
    #[error("predictor.dropout: expected a rate in [0, 1), got {got}")]
    Dropout {
        /// The rate given.
        got: f64,
    },
}

impl Default for ModelConfig {
    fn default() -> ModelConfig {
        ModelConfig {
            image_size: 224,
            encoder: EncoderConfig { patch_size: 14, width: 192, depth: 12, heads: 3, mlp_width: 768 },
            latent_width: 192,
            projector_width: 2048,
            action_bottleneck: 10,
            widen_action_bottleneck: false,
            predictor: PredictorConfig {
                history: 3,
                depth: 6,
                heads: 16,
                head_width: 64,
                mlp_width: 2048,
                dropout: 0.1,
            },
            state_head_width: 256,
            inverse_head_width: 512,
            inverse_input: InverseInput::Pair,
            state_head: true,
            inverse_head: true,
        }
    }
}

impl ModelConfig {
    /// Returns the sizes of a preset (see [`PRESETS`]).
    ///
    /// # Errors
    ///
    /// - [`ConfigError::UnknownPreset`] if there is none of this name.
    pub fn preset(name: &str) -> Result<ModelConfig, ConfigError> {
        match name {
            "tiny-14" => Ok(ModelConfig::default()),
            "nano" => Ok(ModelConfig::scaled(64, 8, 64, 4, 2)),
            "micro" => Ok(ModelConfig::scaled(16, 8, 16, 2, 2)),
            _ => Err(ConfigError::UnknownPreset { name: name.to_owned() }),
        }
    }

    /// Scales the published proportions to tokens and latents of `width`.
    fn scaled(image_size: usize, patch_size: usize, width: usize, depth: usize, heads: usize) -> ModelConfig {
        let predictor = PredictorConfig {
            depth: depth.div_ceil(2),
            heads: 4,
            head_width: width / 4,
            mlp_width: width * 4,
            ..ModelConfig::default().predictor
        };
        ModelConfig {
            image_size,
            encoder: EncoderConfig { patch_size, width, depth, heads, mlp_width: width * 4 },
            latent_width: width,
            projector_width: width * 4,
            predictor,
            state_head_width: width * 2,
            inverse_head_width: width * 2,
            ..ModelConfig::default()
        }
    }

    /// Reads a table such as `preset = "nano"` followed by the fields that differ from it.
    ///
    /// # Errors
    ///
    /// - [`ConfigError::UnknownPreset`] if `preset` names none.
    /// - [`ConfigError::Syntax`] for unknown fields and wrong types; the message names them.
    pub fn from_table(mut table: toml::Table) -> Result<ModelConfig, ConfigError> {
        let syntax = |message: String| ConfigError::Syntax { message };
        let preset = match table.remove("preset") {
            None => ModelConfig::default(),
            Some(toml::Value::String(name)) => ModelConfig::preset(&name)?,
            Some(other) => {
                return Err(syntax(format!("preset: expected a string, got {}", other.type_str())));
            }
        };
        let mut merged = toml::Table::try_from(&preset).map_err(|error| syntax(error.to_string()))?;
        merge(&mut merged, table);
        merged.try_into().map_err(|error: toml::de::Error| syntax(error.message().to_owned()))
    }

    /// Checks the sizes and joins them with the widths of the data.
    ///
    /// # Errors
    ///
    /// - [`ConfigError::Range`], [`ConfigError::Heads`], [`ConfigError::Dropout`] for sizes that make no model.
    pub fn resolve(mut self, widths: DataWidths) -> Result<Architecture, ConfigError> {
        if self.widen_action_bottleneck {
            self.action_bottleneck = self.action_bottleneck.max(widths.action);
        }
        self.state_head &= widths.state > 0;
        let (encoder, predictor) = (&self.encoder, &self.predictor);
        // The upper limits keep every product of sizes far below overflow and hostile checkpoints cheap to refuse.
        for (field, got, minimum, maximum) in [
            ("encoder.patch_size", encoder.patch_size, 1, 1024),
            ("image_size", self.image_size, encoder.patch_size, 4096),
            ("encoder.width", encoder.width, 1, 16_384),
            ("encoder.depth", encoder.depth, 1, 256),
            ("encoder.heads", encoder.heads, 1, 256),
            ("encoder.mlp_width", encoder.mlp_width, 1, 65_536),
            ("latent_width", self.latent_width, 2, 16_384),
            ("projector_width", self.projector_width, 1, 65_536),
            ("action_bottleneck", self.action_bottleneck, 1, 16_384),
            ("predictor.history", predictor.history, 1, 1024),
            ("predictor.depth", predictor.depth, 1, 256),
            ("predictor.heads", predictor.heads, 1, 256),
            ("predictor.head_width", predictor.head_width, 1, 1024),
            ("predictor.mlp_width", predictor.mlp_width, 1, 65_536),
            ("state_head_width", self.state_head_width, 1, 65_536),
            ("inverse_head_width", self.inverse_head_width, 1, 65_536),
            ("action width of the data", widths.action, 1, 16_384),
            ("state width of the data", widths.state, 0, 16_384),
        ] {
            if got < minimum || got > maximum {
                return Err(ConfigError::Range { field, minimum, maximum, got });
            }
        }
        if !encoder.width.is_multiple_of(encoder.heads) {
            return Err(ConfigError::Heads { width: encoder.width, heads: encoder.heads });
        }
        if !(0.0..1.0).contains(&predictor.dropout) {
            return Err(ConfigError::Dropout { got: predictor.dropout });
        }
        Ok(Architecture { config: self, widths })
    }
}

impl Architecture {
    /// The sizes; [`ModelConfig::action_bottleneck`] and [`ModelConfig::state_head`] already take the data into account.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// The widths of the data.
    pub fn widths(&self) -> DataWidths {
        self.widths
    }

    /// Number of patches along a side of the position table.
    pub fn table_side(&self) -> usize {
        self.config.image_size / self.config.encoder.patch_size
    }

    /// Width of the input of the inverse dynamics head: 2 D or D.
    pub fn inverse_input_width(&self) -> usize {
        match self.config.inverse_input {
            InverseInput::Pair | InverseInput::PairReversed => 2 * self.config.latent_width,
            InverseInput::Difference => self.config.latent_width,
        }
    }

    /// Returns the architecture as JSON, as checkpoints carry it.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("a struct of numbers and names becomes JSON")
    }

    /// Reads and checks what [`Architecture::to_json`] wrote.
    ///
    /// # Errors
    ///
    /// - [`ConfigError::Syntax`] if it is not such a text, else as [`ModelConfig::resolve`].
    pub fn from_json(text: &str) -> Result<Architecture, ConfigError> {
        let unchecked: Architecture =
            serde_json::from_str(text).map_err(|error| ConfigError::Syntax { message: error.to_string() })?;
        unchecked.config.resolve(unchecked.widths)
    }
}

/// Puts `overrides` over `base`, table by table.
fn merge(base: &mut toml::Table, overrides: toml::Table) {
    for (key, value) in overrides {
        match (base.get_mut(&key), value) {
            (Some(toml::Value::Table(inner)), toml::Value::Table(table)) => merge(inner, table),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTHS: DataWidths = DataWidths { action: 25, state: 33 };

    fn parse(text: &str) -> Result<Architecture, ConfigError> {
        ModelConfig::from_table(text.parse().unwrap())?.resolve(WIDTHS)
    }

    #[test]
    fn overrides_apply_to_the_preset() {
        let architecture =
            parse("preset = \"nano\"\nencoder.depth = 6\nwiden_action_bottleneck = true").unwrap();
        let config = architecture.config();
        assert_eq!((config.encoder.depth, config.encoder.width, config.action_bottleneck), (6, 64, 25));
        assert_eq!(Architecture::from_json(&architecture.to_json()).unwrap(), architecture);
    }

    #[test]
    fn every_preset_resolves() {
        for name in PRESETS {
            ModelConfig::preset(name).unwrap().resolve(WIDTHS).unwrap();
        }
    }

    #[test]
    fn wrong_configs_name_the_field() {
        for (text, field) in [
            ("encoder.dept = 6", "dept"),
            ("preset = \"giant\"", "giant"),
            ("preset = 3", "preset"),
            ("encoder.depth = 0", "encoder.depth"),
            ("encoder.depth = \"six\"", "string"),
            ("encoder.heads = 5", "encoder.heads"),
            ("image_size = 8", "image_size"),
            ("encoder.width = 99999999999", "encoder.width"),
            ("predictor.dropout = 1.0", "predictor.dropout"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(field), "{text}: {error}");
        }
    }
}
