//! What a LeRobot folder holds, for `inspect`.

use std::fmt;

use serde::Serialize;

use super::LerobotRecording;
use crate::log::Damage;
use crate::rows::RowRecording as _;

/// A summary of a folder, in JSON by serde and as text by `Display`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DatasetReport {
    /// Path as named.
    pub path: String,
    /// `v2.0`, `v2.1` or `v3.0`.
    pub version: String,
    /// Rows per second, as declared.
    pub fps: f64,
    /// Episodes in the data.
    pub episodes: usize,
    /// Rows in the data.
    pub frames: u64,
    /// Columns and declared features.
    pub features: Vec<FeatureReport>,
    /// Where metadata and data disagree, and what cannot be read.
    pub damage: Vec<Damage>,
}

/// One column or declared feature.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FeatureReport {
    /// Its name: the topic of a contract.
    pub name: String,
    /// Type as declared; empty when it is not declared.
    pub dtype: String,
    /// Shape as declared.
    pub shape: Vec<usize>,
    /// Why it has no values, if so.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
}

impl LerobotRecording {
    /// Summarises the folder.
    pub fn report(&self) -> DatasetReport {
        let info = &self.dataset().info;
        let feature = |name: &str, problem: Option<String>| {
            let declared = info.feature(name);
            FeatureReport {
                name: name.to_owned(),
                dtype: declared.map(|feature| feature.dtype_name.clone()).unwrap_or_default(),
                shape: declared.map(|feature| feature.shape.clone()).unwrap_or_default(),
                problem,
            }
        };
        let here = self.channels().iter().map(|channel| feature(&channel.topic, None));
        let absent = self.unavailable().iter().map(|found| feature(&found.topic, Some(found.detail.clone())));
        let (episodes, frames) = self.counts();
        DatasetReport {
            path: self.path().display().to_string(),
            version: info.version.text().to_owned(),
            fps: info.fps,
            episodes,
            frames,
            features: here.chain(absent).collect(),
            damage: self.damage().to_vec(),
        }
    }
}

impl fmt::Display for DatasetReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: LeRobot {}", self.path, self.version)?;
        writeln!(f, "  {} episodes, {} frames at {} Hz", self.episodes, self.frames, self.fps)?;
        writeln!(f, "  columns")?;
        let width = self.features.iter().map(|feature| feature.name.len()).max().unwrap_or(0);
        for feature in &self.features {
            let problem = feature.problem.as_ref().map(|text| format!("  {text}")).unwrap_or_default();
            writeln!(f, "    {:<width$}  {:<7} {:?}{problem}", feature.name, feature.dtype, feature.shape)?;
        }
        if !self.damage.is_empty() {
            writeln!(f, "  noticed")?;
        }
        self.damage.iter().try_for_each(|found| writeln!(f, "    {}: {}", found.kind.as_str(), found.detail))
    }
}
