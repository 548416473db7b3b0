//! Errors of a comparison, tensor by tensor.

use std::fmt;

/// The errors of a comparison.
#[derive(Debug, Clone)]
pub struct Report {
    lines: Vec<Line>,
    slack: f64,
}

/// The largest error of one tensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Which tensor.
    pub name: String,
    /// The largest error, in the measure of the tolerance; infinite for wrong lengths and NaN.
    pub error: f64,
    /// The tolerance.
    pub tolerance: f64,
    /// Position of the largest error.
    pub index: usize,
    /// What the published modules say there.
    pub expected: f64,
    /// What ours say there.
    pub got: f64,
}

impl Report {
    /// `slack` multiplies every tolerance.
    pub(super) fn new(slack: f64) -> Report {
        Report { lines: Vec::new(), slack }
    }

    /// All tensors, in the order compared.
    pub fn lines(&self) -> &[Line] {
        &self.lines
    }

    /// The tensors beyond their tolerance.
    pub fn failures(&self) -> impl Iterator<Item = &Line> {
        self.lines.iter().filter(|line| line.fails())
    }

    /// The tensor whose error is the largest share of its tolerance, among those whose name starts with `prefix`.
    pub fn worst(&self, prefix: &str) -> Option<&Line> {
        let lines = self.lines.iter().filter(|line| line.name.starts_with(prefix));
        lines.max_by(|a, b| a.share().total_cmp(&b.share()))
    }

    /// Error |ours - reference| / (1 + |reference|).
    pub(super) fn values(&mut self, name: &str, ours: &[f64], reference: &[f64], tolerance: f64) {
        self.push(name, ours, reference, tolerance, |reference| 1.0 + reference.abs());
    }

    /// As [`Report::values`], of the first values of ours.
    pub(super) fn head(&mut self, name: &str, ours: &[f64], reference: &[f64], tolerance: f64) {
        self.values(name, &ours[..reference.len().min(ours.len())], reference, tolerance);
    }

    /// Error |ours - reference| / |reference|.
    pub(super) fn relative(&mut self, name: &str, ours: &[f64], reference: &[f64], tolerance: f64) {
        self.push(name, ours, reference, tolerance, f64::abs);
    }

    /// Error |ours - reference|.
    pub(super) fn absolute(&mut self, name: &str, ours: &[f64], reference: &[f64], tolerance: f64) {
        self.push(name, ours, reference, tolerance, |_| 1.0);
    }

    fn push(
        &mut self,
        name: &str,
        ours: &[f64],
        reference: &[f64],
        tolerance: f64,
        scale: impl Fn(f64) -> f64,
    ) {
        let mut line = Line {
            name: name.to_owned(),
            error: 0.0,
            tolerance: tolerance * self.slack,
            index: 0,
            expected: reference.first().copied().unwrap_or(f64::NAN),
            got: ours.first().copied().unwrap_or(f64::NAN),
        };
        for (index, (&got, &expected)) in ours.iter().zip(reference).enumerate() {
            let difference = (got - expected).abs();
            let error = if difference == 0.0 { 0.0 } else { difference / scale(expected) };
            let error = if error.is_nan() { f64::INFINITY } else { error };
            if error > line.error {
                line = Line { error, index, expected, got, ..line };
            }
        }
        if ours.len() != reference.len() || reference.is_empty() {
            line.error = f64::INFINITY;
        }
        self.lines.push(line);
    }
}

impl Line {
    /// Whether the error is beyond the tolerance.
    pub fn fails(&self) -> bool {
        self.error > self.tolerance
    }

    /// Error over tolerance.
    fn share(&self) -> f64 {
        if self.error == 0.0 { 0.0 } else { self.error / self.tolerance }
    }
}

impl fmt::Display for Line {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let verdict = if self.fails() { "FAIL" } else { "ok" };
        write!(f, "{verdict:4} {:9.2e} of {:8.1e}  {}", self.error, self.tolerance, self.name)?;
        if self.fails() {
            write!(f, " (element {}: expected {}, got {})", self.index, self.expected, self.got)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_answers_are_found() {
        let mut report = Report::new(1.0);
        report.values("close", &[1.0, 2.0], &[1.0, 2.0 + 2e-5], 1e-5);
        report.values("far", &[1.0, 2.0], &[1.0, 2.1], 1e-5);
        report.values("short", &[1.0], &[1.0, 2.0], 1e-5);
        report.values("nothing", &[], &[], 1e-5);
        report.values("nan", &[f64::NAN], &[1.0], 1e-5);
        report.relative("relative", &[1e-6], &[1.1e-6], 0.05);
        report.absolute("absolute", &[1e-6], &[1.1e-6], 0.05);
        let failures: Vec<&str> = report.failures().map(|line| line.name.as_str()).collect();
        assert_eq!(failures, ["far", "short", "nothing", "nan", "relative"]);
        assert_eq!(report.worst("far").map(|line| (line.index, line.expected)), Some((1, 2.1)));
        assert!(report.lines()[1].to_string().contains("element 1: expected 2.1, got 2"));
    }
}
