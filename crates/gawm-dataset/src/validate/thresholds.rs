//! The bounds of the rules, which `--rules R.toml` overrides.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Severity, catalogue};

/// Bounds and severities of all rules.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Thresholds {
    /// Severity by code, where it is not the rule's own; `off` silences a rule.
    pub severity: BTreeMap<String, Severity>,
    /// Bounds of TIME.
    pub time: TimeThresholds,
    /// Bounds of IMAGE.
    pub image: ImageThresholds,
    /// Bounds of VALUE.
    pub value: ValueThresholds,
    /// Bounds of SEMANTIC.
    pub semantic: SemanticThresholds,
    /// Bounds of SPLIT.
    pub split: SplitThresholds,
}

macro_rules! thresholds {
    ($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $value:expr,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name { $($(#[$field_doc])* pub $field: f64,)* }
        impl Default for $name {
            fn default() -> Self { $name { $($field: $value,)* } }
        }
    };
}

thresholds! {
    /// Bounds of the rules in group TIME.
    TimeThresholds {
        /// A step of more than this many periods is a gap (TIME-003).
        gap_periods: 3.0,
        /// A step of more than this many periods is worth a note (TIME-003, info).
        late_periods: 1.5,
        /// Largest distance from frame_index / fps in seconds: lerobot's tolerance (TIME-004).
        grid_secs: 1e-4,
        /// Largest drift in parts per million (TIME-005, TIME-012).
        drift_ppm: 100.0,
        /// Largest relative deviation of the rate (TIME-006).
        rate_share: 0.01,
        /// Largest 95th percentile of the jitter, in periods (TIME-007).
        jitter_periods: 0.2,
        /// Motion of one step that equals at least this many steps means missing rows (TIME-008).
        squeezed_steps: 2.6,
        /// Share of repeated rows in motion above which repeating is taken as the stream's nature (TIME-009).
        repeated_share: 0.05,
        /// Largest age of a sample in periods (TIME-011).
        stale_periods: 10.0,
        /// Largest offset between stamps and log times in seconds (TIME-013).
        offset_secs: 1.0,
    }
}

thresholds! {
    /// Bounds of the rules in group IMAGE.
    ImageThresholds {
        /// Mean luma (0..255) below which, with little contrast, a frame is black (IMAGE-004).
        black_luma: 12.0,
        /// Mean luma above which, with little contrast, a frame is white (IMAGE-005).
        white_luma: 243.0,
        /// Largest standard deviation of luma of a black or white frame.
        flat_luma: 6.0,
        /// Shortest frozen stretch in seconds (IMAGE-006).
        frozen_secs: 0.3,
        /// A frame that differs from its neighbours this many times more than they differ from each other (IMAGE-008).
        odd_ratio: 6.0,
        /// Distance of an episode's brightness from the others, in their robust standard deviations (IMAGE-010).
        exposure_sigmas: 8.0,
        /// Lag of an episode's picture against the others, in rows (IMAGE-016).
        lag_rows: 3.0,
    }
}

thresholds! {
    /// Bounds of the rules in group VALUE.
    ValueThresholds {
        /// Shortest stuck stretch in seconds (VALUE-003).
        stuck_secs: 0.3,
        /// Shortest stuck stretch in rows (VALUE-003).
        stuck_rows: 8.0,
        /// A stuck stretch is this many times longer than the signal usually rests (VALUE-003).
        stuck_ratio: 3.0,
        /// Share of a run's rows on a clipped plateau (VALUE-004).
        saturated_share: 0.01,
        /// The same for actions, which operators and policies drive to their limits (VALUE-004).
        saturated_action_share: 0.1,
        /// A jump is this many times the 99th percentile of unsteadiness (VALUE-005).
        jump_ratio: 8.0,
        /// A jump is at least this share of the signal's range (VALUE-005).
        jump_range_share: 0.05,
        /// Share of rows beyond 2 pi under a radian label (VALUE-006).
        degrees_share: 0.01,
        /// Largest deviation of a quaternion's norm from 1 (VALUE-008).
        quaternion_norm: 0.01,
        /// Largest deviation of sin^2 + cos^2 from 1 (VALUE-010).
        circle: 1e-4,
        /// Largest deviation from orthonormality (VALUE-011).
        orthonormal: 1e-3,
        /// Share of the range by which declared limits may be passed (VALUE-012).
        limit_slack: 0.01,
        /// Ratio of an episode's scale to the others' (VALUE-013).
        scale_ratio: 8.0,
        /// Ratio of the noise in an interval to the usual (VALUE-015).
        noise_ratio: 6.0,
        /// Distance of an episode's mean from the others, in their robust standard deviations (VALUE-016).
        offset_sigmas: 12.0,
    }
}

thresholds! {
    /// Bounds of the rules in group SEMANTIC.
    SemanticThresholds {
        /// How much better another shift must explain the motion of all episodes, as a ratio of residuals (SEMANTIC-001).
        shift_residual_ratio: 0.8,
        /// How much better another joint must correlate (SEMANTIC-002).
        permuted_margin: 0.3,
        /// Least correlation of action and state difference for a delta (SEMANTIC-003).
        delta_correlation: 0.8,
        /// Least correlation of steps below which actions explain nothing (SEMANTIC-005).
        unexplained_correlation: 0.05,
        /// Shortest task text in characters (SEMANTIC-006).
        task_chars: 8.0,
        /// Least correlation for a verdict on sign and scale (SEMANTIC-007, SEMANTIC-008).
        sure_correlation: 0.8,
        /// Share of idle rows (SEMANTIC-011).
        idle_share: 0.5,
        /// Largest R2 of a target that pictures do not show (SEMANTIC-012).
        probe_r2: 0.05,
        /// Fewest rows for the probe (SEMANTIC-012).
        probe_rows: 500.0,
        /// Least share of windows that survive (SEMANTIC-013).
        window_share: 0.5,
        /// Distance of an episode's offset from the others, in their robust standard deviations (SEMANTIC-014).
        offset_sigmas: 12.0,
        /// Least error of a model that holds elsewhere, relative to the size of what it explains (SEMANTIC-016).
        relation_error: 0.5,
        /// Ratio of that error to the largest one elsewhere; more with fewer than ten episodes (SEMANTIC-016).
        relation_ratio: 2.2,
    }
}

thresholds! {
    /// Bounds of the rules in group SPLIT.
    SplitThresholds {
        /// Root mean square distance of near-duplicates, in standard deviations of each dim (SPLIT-002).
        near_sigmas: 0.03,
        /// Share of equal rows that makes an overlap (SPLIT-008).
        shared_rows_share: 0.1,
    }
}

/// Why a file of thresholds cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ThresholdsError {
    /// The text is not such a file.
    #[error("not a file of rules: {0}")]
    Parse(#[from] toml::de::Error),
    /// A code does not exist.
    #[error("expected the code of a rule under [severity], got {code:?}")]
    UnknownCode {
        /// What was given.
        code: String,
    },
}

impl Thresholds {
    /// Reads thresholds from TOML; what is not given keeps its default.
    ///
    /// # Errors
    /// The text is no TOML, has unknown keys, or names a rule that does not exist.
    pub fn from_toml(text: &str) -> Result<Thresholds, ThresholdsError> {
        let thresholds: Thresholds = toml::from_str(text)?;
        match thresholds.severity.keys().find(|code| catalogue::rule(code).is_none()) {
            Some(code) => Err(ThresholdsError::UnknownCode { code: code.clone() }),
            None => Ok(thresholds),
        }
    }
}
