//! Statistics as text for people, and as LeRobot's `stats.json`.

use std::{collections::BTreeMap, fmt::Write};

use serde_json::{Map, Value, json};

use super::{CameraSummary, DatasetStats, is_lerobot_feature};
use crate::read::Dataset;

/// Renders tables for a terminal.
pub fn render_text(stats: &DatasetStats) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    writeln!(out, "{} rows in {} episodes at {} Hz", stats.rows, stats.episodes.len(), stats.fps).ok();
    for column in &stats.columns {
        writeln!(
            out,
            "\n{}\n  {:<24} {:>8} {:>11} {:>11} {:>11} {:>11} {:>11} {:>11} {:>11} {:>10} {:>6} {:>8}",
            column.name,
            "dim",
            "missing",
            "mean",
            "std",
            "min",
            "q01",
            "q50",
            "q99",
            "max",
            "speed/s",
            "idle",
            "memory s"
        )
        .ok();
        for dim in &column.dims {
            let s = dim.values.summary();
            let motion = dim.motion.summary(stats.fps);
            let memory = motion.autocorrelation_secs.map_or("> 128 r".to_owned(), |m| format!("{m:.2}"));
            let name =
                if dim.unit.is_empty() { dim.name.clone() } else { format!("{} [{}]", dim.name, dim.unit) };
            writeln!(
                out,
                "  {name:<24} {:>8} {:>11.5} {:>11.5} {:>11.5} {:>11.5} {:>11.5} {:>11.5} {:>11.5} {:>10.4} {:>5.0}% {memory:>8}",
                s.n_missing, s.mean, s.std, s.min, s.q01, s.q50, s.q99, s.max, motion.mean_speed, 100.0 * motion.idle_share
            )
            .ok();
        }
    }
    out
}

/// Returns the content of LeRobot's `meta/stats.json`.
///
/// Cameras whose frames are in video files keep the statistics that the dataset already has.
pub fn lerobot_stats(
    dataset: &Dataset,
    stats: &DatasetStats,
    cameras: &BTreeMap<String, CameraSummary>,
) -> Value {
    let mut features = Map::new();
    for column in stats.columns.iter().filter(|c| is_lerobot_feature(dataset, &c.name)) {
        let summaries: Vec<_> = column.dims.iter().map(|d| d.values.summary()).collect();
        let list = |f: fn(&gawm_schema::DimSummary) -> f64| summaries.iter().map(f).collect::<Vec<f64>>();
        features.insert(
            column.name.clone(),
            json!({
                "min": list(|s| s.min), "max": list(|s| s.max), "mean": list(|s| s.mean), "std": list(|s| s.std),
                "count": [summaries.first().map_or(0, |s| s.count)], "q01": list(|s| s.q01), "q10": list(|s| s.q10),
                "q50": list(|s| s.q50), "q90": list(|s| s.q90), "q99": list(|s| s.q99),
            }),
        );
    }
    for feature in dataset.info.features.iter().filter(|f| f.is_camera()) {
        if let Some(camera) = cameras.get(&feature.name) {
            let n_channels = feature.image_size().map_or(3, |(_, _, c)| c).min(3);
            let list = |k: usize| {
                camera.channels.iter().take(n_channels).map(|c| json!([[c[k]]])).collect::<Vec<_>>()
            };
            features.insert(
                feature.name.clone(),
                json!({
                    "min": list(0), "max": list(1), "mean": list(2), "std": list(3), "count": [camera.frames],
                    "q01": list(4), "q10": list(5), "q50": list(6), "q90": list(7), "q99": list(8),
                }),
            );
        } else if let Some(kept) = dataset.stats.as_ref().and_then(|s| s.get(&feature.name)) {
            features.insert(feature.name.clone(), kept.clone());
        }
    }
    Value::Object(features)
}
