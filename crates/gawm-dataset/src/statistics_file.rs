//! `meta/gawm-statistics.json`: what LeRobot's statistics have no place for.

use std::collections::BTreeMap;

use gawm_schema::{Circular, DimStats, DimSummary, Histogram};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::camera::{CameraStats, pixel_unit};
use crate::columns::Columns;
use crate::episode::FeatureStats;
use crate::totals::Totals;

/// The content of `meta/gawm-statistics.json`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StatisticsFile {
    /// Per column the statistics of each dim.
    pub columns: BTreeMap<String, Vec<DimStatistics>>,
    /// Per camera the pixel counts of the sampled frames.
    pub cameras: BTreeMap<String, CameraStats>,
}

/// Statistics of one dim over all rows of the dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DimStatistics {
    /// Name of the dim.
    pub name: String,
    /// Counts, moments and quantiles.
    pub summary: DimSummary,
    /// Whether quantiles are exact; if not, their rank error is below 0.5 %.
    pub has_exact_quantiles: bool,
    /// Histogram.
    pub histogram: Histogram,
    /// Sums of sines and cosines of an angle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub circular: Option<Circular>,
}

impl StatisticsFile {
    /// Collects the statistics of a dataset.
    pub(crate) fn new(
        columns: &Columns,
        totals: &Totals,
        cameras: &BTreeMap<String, CameraStats>,
    ) -> StatisticsFile {
        let names = column_dims(columns);
        let by_column = names
            .into_iter()
            .zip(&totals.completed(columns))
            .map(|((column, dims), stats)| {
                let entries = dims.into_iter().zip(stats).map(|(name, stats)| dim_statistics(name, stats));
                (column, entries.collect())
            })
            .collect();
        StatisticsFile { columns: by_column, cameras: cameras.clone() }
    }
}

/// Returns name and dim names of each column with statistics, in the order of [`Totals::completed`].
fn column_dims(columns: &Columns) -> Vec<(String, Vec<String>)> {
    let vectors = columns.vectors.iter().map(|v| (v.name.clone(), v.dim_names.clone()));
    let encoded = columns
        .encoded
        .iter()
        .map(|e| (e.name.to_owned(), e.encoder.dims().iter().map(|dim| dim.name.clone()).collect()));
    vectors.chain(encoded).collect()
}

fn dim_statistics(name: String, stats: &DimStats) -> DimStatistics {
    DimStatistics {
        name,
        summary: stats.summary(),
        has_exact_quantiles: stats.sketch.is_exact(),
        histogram: stats.histogram.clone(),
        circular: stats.circular,
    }
}

/// Returns LeRobot's `meta/stats.json`.
pub(crate) fn lerobot_stats(
    columns: &Columns,
    totals: &Totals,
    cameras: &BTreeMap<String, CameraStats>,
) -> Value {
    let mut features = serde_json::Map::new();
    for ((name, _), dims) in column_dims(columns).into_iter().zip(&totals.completed(columns)) {
        let summaries: Vec<DimSummary> = dims.iter().map(DimStats::summary).collect();
        features.insert(name, stats_json(&FeatureStats::of(&summaries), |v| json!(v)));
    }
    for image in &columns.images {
        if let Some(camera) = cameras.get(&image.name) {
            let stats = camera.feature_stats(pixel_unit(&image.spec));
            features.insert(image.name.clone(), stats_json(&stats, |v| json!([[v]])));
        }
    }
    Value::Object(features)
}

fn stats_json(stats: &FeatureStats, value: fn(f64) -> Value) -> Value {
    let mut object = serde_json::Map::new();
    for (name, values) in stats.named() {
        object.insert(name.to_owned(), values.iter().map(|&v| value(v)).collect());
    }
    object.insert("count".to_owned(), json!([stats.count]));
    Value::Object(object)
}
