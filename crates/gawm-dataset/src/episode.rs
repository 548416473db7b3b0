//! What is known of a finished episode: one row of the episode table.

use std::collections::BTreeMap;

use gawm_schema::{ContentHash, DimSummary};
use serde::{Deserialize, Serialize};

/// One finished episode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct EpisodeRecord {
    pub(crate) id: String,
    pub(crate) task: String,
    pub(crate) length: u64,
    /// Number of the data file that holds it.
    pub(crate) file: u64,
    /// First row in the dataset.
    pub(crate) from_index: u64,
    pub(crate) success: Option<bool>,
    pub(crate) operator: String,
    pub(crate) robot: String,
    pub(crate) session: String,
    pub(crate) is_training: bool,
    /// Position of its recording in `meta/gawm.json`.
    pub(crate) recording: u64,
    pub(crate) source_file: String,
    pub(crate) source_hash: ContentHash,
    pub(crate) start_ns: i64,
    pub(crate) end_ns: i64,
    /// Hash of the rows as stored.
    pub(crate) content_hash: ContentHash,
    pub(crate) tags: BTreeMap<String, String>,
    /// Per policy input and statistic the values, one per dim or channel.
    pub(crate) stats: BTreeMap<String, FeatureStats>,
}

/// LeRobot's statistics of one feature: one value per dim, or per channel of a camera.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FeatureStats {
    pub(crate) min: Vec<f64>,
    pub(crate) max: Vec<f64>,
    pub(crate) mean: Vec<f64>,
    pub(crate) std: Vec<f64>,
    pub(crate) q01: Vec<f64>,
    pub(crate) q10: Vec<f64>,
    pub(crate) q50: Vec<f64>,
    pub(crate) q90: Vec<f64>,
    pub(crate) q99: Vec<f64>,
    pub(crate) count: u64,
}

impl FeatureStats {
    /// Collects the summaries of all dims.
    pub(crate) fn of(summaries: &[DimSummary]) -> FeatureStats {
        let values = |value: fn(&DimSummary) -> f64| summaries.iter().map(value).collect();
        FeatureStats {
            min: values(|s| s.min),
            max: values(|s| s.max),
            mean: values(|s| s.mean),
            std: values(|s| s.std),
            q01: values(|s| s.q01),
            q10: values(|s| s.q10),
            q50: values(|s| s.q50),
            q90: values(|s| s.q90),
            q99: values(|s| s.q99),
            count: summaries.iter().map(|s| s.count).max().unwrap_or(0),
        }
    }

    /// Returns the statistics in an entry of LeRobot's `stats.json`, whatever shape its lists have.
    pub(crate) fn from_json(value: &serde_json::Value) -> Option<FeatureStats> {
        let mut stats = FeatureStats::default();
        for (name, values) in value.as_object()? {
            let mut numbers = Vec::new();
            flatten(values, 0, &mut numbers);
            match stats.slot(name) {
                Some(slot) => *slot = numbers,
                None if name == "count" => stats.count = numbers.first().map_or(0, |count| *count as u64),
                None => {}
            }
        }
        // Quantiles are newer than the rest.
        let FeatureStats { min, max, mean, q01, q10, q50, q90, q99, .. } = &mut stats;
        for (quantile, stand_in) in [(q01, &*min), (q10, min), (q50, mean), (q90, max), (q99, max)] {
            if quantile.is_empty() {
                quantile.clone_from(stand_in);
            }
        }
        let width = stats.mean.len();
        let is_whole = width > 0 && stats.named().iter().all(|(_, values)| values.len() == width);
        is_whole.then_some(stats)
    }

    /// Returns name and values of each statistic but the count.
    pub(crate) fn named(&self) -> [(&'static str, &[f64]); 9] {
        [
            ("min", &self.min),
            ("max", &self.max),
            ("mean", &self.mean),
            ("std", &self.std),
            ("q01", &self.q01),
            ("q10", &self.q10),
            ("q50", &self.q50),
            ("q90", &self.q90),
            ("q99", &self.q99),
        ]
    }

    /// Returns the place of each statistic by its name.
    pub(crate) fn slot(&mut self, name: &str) -> Option<&mut Vec<f64>> {
        Some(match name {
            "min" => &mut self.min,
            "max" => &mut self.max,
            "mean" => &mut self.mean,
            "std" => &mut self.std,
            "q01" => &mut self.q01,
            "q10" => &mut self.q10,
            "q50" => &mut self.q50,
            "q90" => &mut self.q90,
            "q99" => &mut self.q99,
            _ => return None,
        })
    }
}

/// Collects the numbers in nested lists.
fn flatten(value: &serde_json::Value, depth: usize, out: &mut Vec<f64>) {
    match value {
        serde_json::Value::Array(items) if depth < 5 => {
            items.iter().take(4096).for_each(|item| flatten(item, depth + 1, out));
        }
        other => out.extend(other.as_f64()),
    }
}

/// Returns whether LeRobot gives a feature of this name to policies, so that it needs statistics.
pub(crate) fn is_policy_input(name: &str) -> bool {
    name.starts_with("observation") || name.starts_with("action")
}
