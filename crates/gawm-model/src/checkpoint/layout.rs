//! Keys of published checkpoints, and the sizes that their shapes tell.

use std::collections::BTreeMap;

use crate::config::{DataWidths, InverseInput, ModelConfig};

/// How the keys of the encoder are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum KeyLayout {
    /// `encoder.layers.N.attention.q_proj`, as transformers 5 and we do.
    #[default]
    Transformers5,
    /// `encoder.encoder.layer.N.attention.attention.query`, as transformers 4 did.
    Transformers4,
}

/// What the shapes of a checkpoint do not tell; the published widths of a head are 64.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImportOptions {
    /// Width of an attention head in the encoder.
    pub encoder_head_width: usize,
    /// Width of an attention head in the predictor.
    pub predictor_head_width: usize,
}

impl Default for ImportOptions {
    fn default() -> ImportOptions {
        ImportOptions { encoder_head_width: 64, predictor_head_width: 64 }
    }
}

/// The parts of a layer of the encoder: in transformers 4, in transformers 5. The longer names come first.
const PARTS: [(&str, &str); 6] = [
    ("attention.attention.query.", "attention.q_proj."),
    ("attention.attention.key.", "attention.k_proj."),
    ("attention.attention.value.", "attention.v_proj."),
    ("attention.output.dense.", "attention.o_proj."),
    ("intermediate.dense.", "mlp.fc1."),
    ("output.dense.", "mlp.fc2."),
];

/// Returns our name of a published key: transformers 4 or 5, with or without Lightning's prefix `model.`.
pub(super) fn our_key(theirs: &str) -> String {
    let key = theirs.strip_prefix("model.").unwrap_or(theirs);
    if let Some(rest) = key.strip_prefix("encoder.encoder.layer.")
        && let Some((layer, part)) = rest.split_once('.')
    {
        let translated =
            PARTS.iter().find_map(|(old, new)| Some(format!("{new}{}", part.strip_prefix(old)?)));
        return format!("encoder.layers.{layer}.{}", translated.as_deref().unwrap_or(part));
    }
    match key.strip_prefix("state_probe.") {
        // The head as a bare sequence.
        Some(rest) if !rest.starts_with("net.") => format!("state_probe.net.{rest}"),
        _ => key.to_owned(),
    }
}

/// Returns the key of one of our names in a layout.
pub(super) fn their_key(ours: &str, layout: KeyLayout) -> String {
    if layout == KeyLayout::Transformers4
        && let Some(rest) = ours.strip_prefix("encoder.layers.")
        && let Some((layer, part)) = rest.split_once('.')
    {
        let translated =
            PARTS.iter().find_map(|(old, new)| Some(format!("{old}{}", part.strip_prefix(new)?)));
        return format!("encoder.encoder.layer.{layer}.{}", translated.as_deref().unwrap_or(part));
    }
    ours.to_owned()
}

/// Reads sizes off shapes (by our names).
pub(super) fn infer(
    shapes: &BTreeMap<String, Vec<usize>>,
    options: &ImportOptions,
) -> Result<(ModelConfig, DataWidths), String> {
    let shape = |name: &str, rank: usize| match shapes.get(name) {
        Some(shape) if shape.len() == rank => Ok(shape.as_slice()),
        Some(shape) => Err(format!("expected {rank} axes in {name:?}, got shape {shape:?}")),
        None => Err(format!("missing tensor {name:?}: this is no published world model")),
    };
    let count = |prefix: &str| (0..).take_while(|n| any(shapes, &format!("{prefix}.{n}."))).count();

    let mut config = ModelConfig::default();
    let patches = shape("encoder.embeddings.patch_embeddings.projection.weight", 4)?;
    let positions = shape("encoder.embeddings.position_embeddings", 3)?[1];
    let side = positions.saturating_sub(1).isqrt();
    if side * side + 1 != positions {
        return Err(format!("expected a square number of positions and one more, got {positions}"));
    }
    config.encoder.width = patches[0];
    config.encoder.patch_size = patches[2];
    config.image_size = side.saturating_mul(patches[2]);
    config.encoder.depth = count("encoder.layers");
    config.encoder.heads = heads(patches[0], options.encoder_head_width, "encoder")?;
    if config.encoder.depth > 0 {
        config.encoder.mlp_width = shape("encoder.layers.0.mlp.fc1.weight", 2)?[0];
    }

    let projector = shape("projector.net.3.weight", 2)?;
    (config.latent_width, config.projector_width) = (projector[0], projector[1]);
    let embed = shape("action_encoder.patch_embed.weight", 3)?;
    config.action_bottleneck = embed[0];

    config.predictor.history = shape("predictor.pos_embedding", 3)?[1];
    config.predictor.depth = count("predictor.transformer.layers");
    if config.predictor.depth > 0 {
        let inner = shape("predictor.transformer.layers.0.attn.to_out.0.weight", 2)?[1];
        config.predictor.heads = heads(inner, options.predictor_head_width, "predictor")?;
        config.predictor.head_width = options.predictor_head_width;
        config.predictor.mlp_width = shape("predictor.transformer.layers.0.mlp.net.1.weight", 2)?[0];
    }

    config.state_head = any(shapes, "state_probe.");
    config.inverse_head = any(shapes, "idm_head.");
    let mut widths = DataWidths { action: embed[1], state: 0 };
    if config.state_head {
        let head = shape("state_probe.net.3.weight", 2)?;
        (widths.state, config.state_head_width) = (head[0], head[1]);
    }
    if config.inverse_head {
        let inputs = shape("idm_head.net.0.weight", 2)?;
        config.inverse_head_width = inputs[0];
        let difference = inputs[1] == config.latent_width;
        config.inverse_input = if difference { InverseInput::Difference } else { InverseInput::Pair };
    }
    Ok((config, widths))
}

fn any(shapes: &BTreeMap<String, Vec<usize>>, prefix: &str) -> bool {
    shapes.range(prefix.to_owned()..).next().is_some_and(|(name, _)| name.starts_with(prefix))
}

fn heads(width: usize, head_width: usize, part: &str) -> Result<usize, String> {
    if head_width == 0 || !width.is_multiple_of(head_width) {
        return Err(format!(
            "the {part} has width {width}: expected a multiple of the head width {head_width}"
        ));
    }
    Ok(width / head_width)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_of_both_layouts_are_understood() {
        for (theirs, ours) in [
            (
                "encoder.encoder.layer.3.attention.attention.query.weight",
                "encoder.layers.3.attention.q_proj.weight",
            ),
            (
                "encoder.encoder.layer.11.attention.output.dense.bias",
                "encoder.layers.11.attention.o_proj.bias",
            ),
            ("encoder.encoder.layer.0.intermediate.dense.weight", "encoder.layers.0.mlp.fc1.weight"),
            ("encoder.encoder.layer.0.output.dense.weight", "encoder.layers.0.mlp.fc2.weight"),
            ("encoder.encoder.layer.0.layernorm_after.bias", "encoder.layers.0.layernorm_after.bias"),
            ("encoder.layers.2.attention.k_proj.bias", "encoder.layers.2.attention.k_proj.bias"),
            ("model.predictor.pos_embedding", "predictor.pos_embedding"),
            ("state_probe.0.weight", "state_probe.net.0.weight"),
            ("state_probe.net.0.weight", "state_probe.net.0.weight"),
        ] {
            assert_eq!(our_key(theirs), ours);
        }
    }

    #[test]
    fn the_old_layout_is_undone_by_ours() {
        for part in [
            "attention.q_proj.weight",
            "attention.o_proj.bias",
            "mlp.fc1.bias",
            "mlp.fc2.bias",
            "layernorm_before.weight",
        ] {
            let ours = format!("encoder.layers.7.{part}");
            let theirs = their_key(&ours, KeyLayout::Transformers4);
            assert!(theirs.starts_with("encoder.encoder.layer.7."), "{theirs}");
            assert_eq!(our_key(&theirs), ours);
        }
    }
}
