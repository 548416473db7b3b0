//! What a validation found.

use serde::{Deserialize, Serialize};

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// The rule is switched off.
    Off,
    /// Worth knowing; training is not harmed.
    Info,
    /// Probably harmful: look at it before training.
    Warning,
    /// Certainly broken.
    Error,
}

impl Severity {
    /// Returns the severity's name.
    pub fn text(self) -> &'static str {
        match self {
            Severity::Off => "off",
            Severity::Info => "info",
            Severity::Warning => "warning",
            Severity::Error => "error",
        }
    }
}

/// One thing that a rule found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Stable code of the rule, such as `TIME-003`.
    pub code: &'static str,
    /// How bad it is.
    pub severity: Severity,
    /// The episode, unless the whole dataset is concerned.
    pub episode: Option<i64>,
    /// The episodes, where one finding is about several.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub episodes: Vec<i64>,
    /// Rows `[first, end)` within the episode, where they are known.
    pub rows: Option<[u64; 2]>,
    /// The feature concerned.
    pub feature: Option<String>,
    /// The dim of the feature, by name or number.
    pub dim: Option<String>,
    /// What was measured, in the unit that the message names.
    pub measured: Option<f64>,
    /// The bound it was compared with.
    pub threshold: Option<f64>,
    /// What was found, for people.
    pub message: String,
    /// What to do.
    pub hint: &'static str,
}

impl Finding {
    /// Returns a finding of rule `code` about the whole dataset; severity and hint are filled in from the catalogue later.
    pub fn new(code: &'static str, message: impl Into<String>) -> Finding {
        Finding {
            code,
            severity: Severity::Off,
            episode: None,
            episodes: Vec::new(),
            rows: None,
            feature: None,
            dim: None,
            measured: None,
            threshold: None,
            message: message.into(),
            hint: "",
        }
    }

    /// Returns the finding, about one episode.
    #[must_use]
    pub fn episode(mut self, episode: i64) -> Finding {
        self.episode = Some(episode);
        self
    }

    /// Returns the finding, about several episodes.
    #[must_use]
    pub fn episodes(mut self, episodes: Vec<i64>) -> Finding {
        self.episodes = episodes;
        self
    }

    /// Returns the finding, about rows `first..end` of the episode.
    #[must_use]
    pub fn rows(mut self, first: usize, end: usize) -> Finding {
        self.rows = Some([first as u64, end as u64]);
        self
    }

    /// Returns the finding, about one feature.
    #[must_use]
    pub fn feature(mut self, feature: &str) -> Finding {
        self.feature = Some(feature.to_owned());
        self
    }

    /// Returns the finding, about one dim.
    #[must_use]
    pub fn dim(mut self, dim: &str) -> Finding {
        if !dim.is_empty() {
            self.dim = Some(dim.to_owned());
        }
        self
    }

    /// Returns the finding with the measured value and the bound; what is not finite is left out.
    #[must_use]
    pub fn measured(mut self, measured: f64, threshold: f64) -> Finding {
        self.measured = Some(measured).filter(|v| v.is_finite());
        self.threshold = Some(threshold).filter(|v| v.is_finite());
        self
    }

    /// Returns the finding with a severity other than the rule's own.
    #[must_use]
    pub fn at(mut self, severity: Severity) -> Finding {
        self.severity = severity;
        self
    }
}

/// The result of a validation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Name of the folder.
    pub dataset: String,
    /// The layout.
    pub format: &'static str,
    /// Number of episodes.
    pub episodes: u64,
    /// Number of rows.
    pub rows: u64,
    /// Number of findings by severity.
    pub counts: Counts,
    /// Training windows that survive.
    pub windows: super::WindowYield,
    /// The findings: worst first, then by code and place.
    pub findings: Vec<Finding>,
    /// How many findings were left out, per code, where a rule found very many.
    pub left_out: std::collections::BTreeMap<&'static str, u64>,
}

/// Numbers of findings.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Errors.
    pub error: u64,
    /// Warnings.
    pub warning: u64,
    /// Notes.
    pub info: u64,
}
