//! What tests share: a small run in memory.

use std::path::PathBuf;

use gawm_model::{DataWidths, Device, ModelConfig, WorldModel};
use gawm_schema::ContentHash;
use gawm_schema::batch::{
    Baselines, BatchLayout, BatchShape, ClipCounts, DatasetInfo, EncodedFeature, HELLO_VERSION, Hello,
    Sequence, StandardisedDimInfo,
};

use crate::run::Run;

/// Side of the frames of the run.
pub(crate) const SIZE: usize = 16;

/// Two dims with this mean and scale.
pub(crate) fn feature(feature: &str, mean: f64, scale: f64) -> EncodedFeature {
    let dim = |name: &str| StandardisedDimInfo {
        name: name.to_owned(),
        feature: feature.to_owned(),
        unit: serde_json::from_str("\"m\"").unwrap(),
        mean,
        scale,
        is_constant: false,
        min: -1.5,
        max: 1.5,
    };
    EncodedFeature {
        dims: vec![dim("x"), dim("y")],
        fitted_on: "train".to_owned(),
        fitted_hash: ContentHash::of(b"fitted"),
    }
}

/// What loaders would say of TwoRoom in frames of 16 pixels.
pub(crate) fn hello() -> Hello {
    let shape = BatchShape {
        clips: 4,
        frames: 4,
        views: 1,
        height: SIZE,
        width: SIZE,
        channels: 3,
        action_width: 10,
        state_width: 2,
    };
    let schema_hash = ContentHash::of(b"schema");
    Hello {
        format_version: HELLO_VERSION,
        datasets: vec![DatasetInfo {
            path: "data".to_owned(),
            content_hash: ContentHash::of(b"content"),
            schema_hash,
            share: 1.0,
            rows: 100,
        }],
        schema_hash,
        layout_hash: BatchLayout::try_new(shape).unwrap().hash(),
        shape,
        sequence: Sequence { total_steps: 1, validate_every: 0, validation_batches: 0, steps_per_epoch: 1 },
        ranks: 1,
        seed: 1,
        compat: "repaired".to_owned(),
        frameskip: 5,
        history: 3,
        span: 16,
        rate_hz: 10.0,
        cameras: vec!["observation.images.camera".to_owned()],
        state: feature("observation.state", 112.0, 50.0),
        action: feature("action", 0.0, 0.75),
        train: ClipCounts::default(),
        validation: ClipCounts::default(),
        baselines: Baselines { state_variance: vec![1.0; 2], action_variance: vec![1.0; 2] },
    }
}

/// An untrained run of the micro model.
pub(crate) fn run(seed: u64) -> Run {
    let architecture =
        ModelConfig::preset("micro").unwrap().resolve(DataWidths { action: 10, state: 2 }).unwrap();
    Run {
        path: PathBuf::from("run"),
        method: "sa-idm".to_owned(),
        seed: Some(seed),
        model: WorldModel::new(architecture, seed, &Device::Cpu).unwrap(),
        checkpoint: "best".to_owned(),
        hello: hello(),
    }
}
