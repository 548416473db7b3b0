//! Rules of group STRUCT: what the reader noticed, and stored statistics against the data.

use serde_json::Value;

use super::{
    Finding, Severity,
    profile::{Plan, RunProfile},
};
use crate::read::{Dataset, Defect, DefectKind};

/// Turns what the reader noticed into findings.
pub(super) fn judge_defects(dataset: &Dataset, defects: &[Defect]) -> Vec<Finding> {
    defects.iter().map(|defect| finding_of(dataset, defect)).collect()
}

fn finding_of(dataset: &Dataset, defect: &Defect) -> Finding {
    let (code, severity) = match defect.kind {
        DefectKind::InfoKey => ("STRUCT-001", None),
        DefectKind::BadMetadata => ("STRUCT-002", None),
        DefectKind::UnsafePath => ("STRUCT-003", None),
        DefectKind::MissingFile => ("STRUCT-004", None),
        DefectKind::UnreadableFile => ("STRUCT-005", None),
        DefectKind::StrayFile => ("STRUCT-006", None),
        // Old folders of other converters lack frame_index; nothing reads it.
        DefectKind::MissingColumn if defect.place == "frame_index" && dataset.info.version.is_v2() => {
            ("STRUCT-007", Some(Severity::Info))
        }
        DefectKind::MissingColumn => ("STRUCT-007", None),
        DefectKind::UndeclaredColumn => ("STRUCT-008", None),
        DefectKind::WrongType => ("STRUCT-009", None),
        DefectKind::NullRows => ("STRUCT-010", None),
        DefectKind::WrongWidth => ("STRUCT-011", None),
        DefectKind::BrokenRuns => ("STRUCT-012", None),
        DefectKind::WrongCount => ("STRUCT-013", None),
        DefectKind::EpisodeTable => ("STRUCT-014", None),
        DefectKind::TaskTable => ("STRUCT-015", None),
        DefectKind::BadFeature => ("STRUCT-016", None),
        DefectKind::TooLarge => ("STRUCT-021", None),
    };
    let message = format!("{}: expected {}, got {}", defect.place, defect.expected, defect.got);
    let mut finding = Finding::new(code, message);
    finding.episode = defect.episode;
    if let Some(severity) = severity {
        finding.severity = severity;
    }
    let is_column = matches!(
        defect.kind,
        DefectKind::MissingColumn | DefectKind::UndeclaredColumn | DefectKind::WrongType
    );
    if is_column { finding.feature(&defect.place) } else { finding }
}

/// Compares `meta/stats.json` with the data: mean, minimum and maximum of states and actions.
pub(super) fn judge_stats(dataset: &Dataset, plan: &Plan, runs: &[RunProfile]) -> Vec<Finding> {
    let mut findings = Vec::new();
    let Some(stats) = &dataset.stats else {
        let is_needed = !dataset.defects.iter().any(|d| d.place == "meta/stats.json");
        if is_needed && !dataset.info.version.is_v2() {
            let message = "meta/stats.json: expected statistics, got no file: policies that normalise cannot be trained";
            findings.push(Finding::new("STRUCT-020", message));
        }
        return findings;
    };
    // Statistics of a dataset of which only a part lies here describe the whole one.
    let is_partial = dataset
        .defects
        .iter()
        .any(|d| matches!(d.kind, DefectKind::MissingFile | DefectKind::UnreadableFile));
    for (feature, layout) in plan.layouts.iter().enumerate() {
        let Some(stored) = stats.get(&layout.name) else { continue };
        for dim in 0..layout.width() {
            let of = |key: &str| stored.get(key).and_then(|v| number_at(v, dim));
            let (Some(mean), Some(min), Some(max)) = (of("mean"), of("min"), of("max")) else { continue };
            let signals = runs
                .iter()
                .filter_map(|r| r.features[feature].as_ref().map(|p| &p.dims[dim]))
                .filter(|s| s.n_finite > 0);
            let (mut n, mut sum, mut low, mut high) = (0.0, 0.0, f64::INFINITY, f64::NEG_INFINITY);
            for signal in signals {
                n += signal.n_finite as f64;
                sum += signal.mean * signal.n_finite as f64;
                low = low.min(signal.min);
                high = high.max(signal.max);
            }
            if n == 0.0 {
                continue;
            }
            let scale = (high - low).max(1e-3 * high.abs().max(low.abs())).max(1e-9);
            let worst = [(mean, sum / n, "mean"), (min, low, "min"), (max, high, "max")]
                .into_iter()
                .map(|(stored, actual, name)| ((stored - actual).abs() / scale, stored, actual, name))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((error, stored, actual, name)) = worst
                && error > 0.01
            {
                let message = format!("{name} is {stored:.6} in meta/stats.json and {actual:.6} in the data");
                let finding = Finding::new("STRUCT-020", message)
                    .feature(&layout.name)
                    .dim(&layout.names[dim])
                    .measured(error, 0.01);
                findings.push(if is_partial { finding.at(Severity::Info) } else { finding });
                break;
            }
        }
    }
    findings
}

fn number_at(value: &Value, dim: usize) -> Option<f64> {
    match value {
        Value::Array(items) => items.get(dim)?.as_f64(),
        other => other.as_f64().filter(|_| dim == 0),
    }
}
