//! The self-test: plants one defect at a time in clean synthetic data, writes it as a folder, and validates that.

mod defects;
mod folder;
mod world;

use std::{collections::BTreeSet, io};

use rayon::prelude::*;
use serde::Serialize;

use super::{Severity, ValidateOptions, validate};
use crate::read::{Dataset, OpenError, ReadLimits, ScanError};

/// Strengths at which each defect is planted; the last is full strength.
const STRENGTHS: [f64; 3] = [0.3, 0.6, 1.0];

/// Why the self-test could not be run.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DemoError {
    /// A synthetic dataset could not be written.
    #[error("cannot write a synthetic dataset: {0}")]
    Write(#[from] io::Error),
    /// A synthetic dataset could not be read.
    #[error("cannot read a synthetic dataset: {0}")]
    Open(#[from] OpenError),
    /// A synthetic dataset could not be scanned.
    #[error("cannot scan a synthetic dataset: {0}")]
    Scan(#[from] ScanError),
}

/// What the self-test found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DemoReport {
    /// Defects planted: kinds times strengths.
    pub planted: u64,
    /// How many of them were found by their rule in their episode.
    pub found: u64,
    /// Defects planted at full strength.
    pub planted_at_full_strength: u64,
    /// How many of those were found.
    pub found_at_full_strength: u64,
    /// Errors and warnings on the clean twins.
    pub false_alarms: u64,
    /// Clean datasets that were validated.
    pub clean_twins: u64,
    /// Per kind of defect what was found.
    pub rules: Vec<DemoRule>,
    /// The false alarms, as text.
    pub false_alarm_texts: Vec<String>,
}

/// One kind of defect.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DemoRule {
    /// Name of the defect.
    pub defect: &'static str,
    /// Code of the rule that must find it.
    pub code: &'static str,
    /// The strengths.
    pub strengths: [f64; 3],
    /// Whether it was found at each strength.
    pub found: [bool; 3],
    /// Other rules of level warning or above that spoke up at full strength.
    pub also: Vec<&'static str>,
}

/// Runs the self-test.
///
/// # Errors
/// A synthetic dataset cannot be written, or not be read although its defect leaves it readable.
pub fn run_demo() -> Result<DemoReport, DemoError> {
    let kinds = defects::DEFECTS;
    let rules = kinds
        .par_iter()
        .enumerate()
        .map(|(i, defect)| test_defect(i, defect, 0..3))
        .collect::<Result<Vec<_>, _>>()?;
    let twins: Vec<(u64, bool)> =
        (0..kinds.len() as u64).map(|i| (i, kinds[i as usize].needs_cameras())).collect();
    let alarms = twins
        .par_iter()
        .map(|(seed, cameras)| clean_alarms(*seed, *cameras))
        .collect::<Result<Vec<_>, _>>()?;
    let false_alarm_texts: Vec<String> = alarms.into_iter().flatten().collect();
    let count = |k: usize| rules.iter().filter(|r| r.found[k]).count() as u64;
    Ok(DemoReport {
        planted: 3 * rules.len() as u64,
        found: (0..3).map(count).sum(),
        planted_at_full_strength: rules.len() as u64,
        found_at_full_strength: count(2),
        false_alarms: false_alarm_texts.len() as u64,
        clean_twins: twins.len() as u64,
        rules,
        false_alarm_texts,
    })
}

impl DemoReport {
    /// Returns whether everything at full strength was found and nothing else.
    pub fn is_perfect(&self) -> bool {
        self.found_at_full_strength == self.planted_at_full_strength && self.false_alarms == 0
    }
}

fn test_defect(
    seed: usize,
    defect: &defects::Defect,
    which: std::ops::Range<usize>,
) -> Result<DemoRule, DemoError> {
    let mut found = [false; 3];
    let mut also = BTreeSet::new();
    for (k, strength) in STRENGTHS.into_iter().enumerate().filter(|(k, _)| which.contains(k)) {
        let mut world = world::clean_world(seed as u64, defect.needs_cameras());
        (defect.plant)(&mut world, strength);
        let dir = tempfile::tempdir()?;
        folder::write(&world, dir.path())?;
        let findings = match Dataset::open(dir.path(), ReadLimits::default()) {
            Ok(dataset) => validate(&dataset, &ValidateOptions::default())?.findings,
            // A folder of which nothing can be read is refused with the reason: that counts as found.
            Err(OpenError::NoData { .. }) if matches!(defect.code, "STRUCT-003" | "STRUCT-005") => {
                found[k] = true;
                continue;
            }
            Err(e) => return Err(e.into()),
        };
        let is_it = |f: &&super::Finding| {
            f.code == defect.code && defect.episode.is_none_or(|e| f.episode == Some(e))
        };
        found[k] = findings.iter().any(|f| is_it(&f) && f.severity >= Severity::Warning);
        if k == 2 {
            also.extend(
                findings
                    .iter()
                    .filter(|f| f.severity >= Severity::Warning && f.code != defect.code)
                    .map(|f| f.code),
            );
        }
    }
    Ok(DemoRule {
        defect: defect.name,
        code: defect.code,
        strengths: STRENGTHS,
        found,
        also: also.into_iter().collect(),
    })
}

/// Validates a clean dataset and returns what is reported all the same.
fn clean_alarms(seed: u64, has_cameras: bool) -> Result<Vec<String>, DemoError> {
    let dir = tempfile::tempdir()?;
    folder::write(&world::clean_world(seed, has_cameras), dir.path())?;
    let dataset = Dataset::open(dir.path(), ReadLimits::default())?;
    let report = validate(&dataset, &ValidateOptions::default())?;
    let alarms = report.findings.iter().filter(|f| f.severity >= Severity::Warning);
    Ok(alarms
        .map(|f| {
            format!(
                "seed {seed}: {} episode {:?} {:?}[{:?}] {}",
                f.code, f.episode, f.feature, f.dim, f.message
            )
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_defect_at_full_strength_is_found_and_clean_data_are_quiet() {
        // Full strength only, and some of the clean twins: the program's --demo does all.
        assert!(defects::DEFECTS.len() >= 24);
        let rules: Vec<DemoRule> =
            defects::DEFECTS.par_iter().enumerate().map(|(i, d)| test_defect(i, d, 2..3).unwrap()).collect();
        let missed: Vec<&str> = rules.iter().filter(|r| !r.found[2]).map(|r| r.defect).collect();
        assert!(missed.is_empty(), "missed: {missed:?}");
        let alarms: Vec<String> =
            (0..8).into_par_iter().flat_map_iter(|seed| clean_alarms(seed, seed < 3).unwrap()).collect();
        assert!(alarms.is_empty(), "{alarms:#?}");
    }
}
