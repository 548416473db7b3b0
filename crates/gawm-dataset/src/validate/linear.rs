//! Linear models of all dims of a robot at once, from the mean products of their values.

/// A part of the diagonal that keeps collinear dims solvable.
const RIDGE: f64 = 1e-4;

/// How well the model of one dim fits one run.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Fit {
    /// Root mean square error, of steps without the worst row, relative to what is expected where that is more than usual.
    pub(super) error: f64,
    /// The same in the usual unit.
    pub(super) plain_error: f64,
    /// Mean error.
    pub(super) bias: f64,
    /// What is found over what is expected.
    pub(super) gain: f64,
    /// Position of the row of the largest error.
    pub(super) worst_row: usize,
}

/// Rows of one run in units of usual spread.
pub(super) struct Standardised {
    /// [row, 1 + dims], begins with 1.
    pub(super) x: Vec<f64>,
    /// [row, targets].
    pub(super) steps: Vec<f64>,
    pub(super) n_rows: usize,
    /// Where in the run the rows are.
    pub(super) rows: Vec<usize>,
}

/// Mean products of the columns of one or more runs, each run with the same weight.
#[derive(Debug, Clone)]
pub(super) struct Moments {
    n_columns: usize,
    n_targets: usize,
    n_runs: f64,
    /// [column, column].
    xx: Vec<f64>,
    /// [column, target].
    xy: Vec<f64>,
}

impl Moments {
    pub(super) fn zero(n_columns: usize, n_targets: usize) -> Moments {
        let (xx, xy) = (vec![0.0; n_columns * n_columns], vec![0.0; n_columns * n_targets]);
        Moments { n_columns, n_targets, n_runs: 0.0, xx, xy }
    }

    pub(super) fn of(run: &Standardised, n_columns: usize, n_targets: usize) -> Moments {
        let mut m = Moments::zero(n_columns, n_targets);
        let weight = 1.0 / run.n_rows as f64;
        for (x, y) in run.x.chunks_exact(n_columns).zip(run.steps.chunks_exact(n_targets)) {
            for (i, value) in x.iter().enumerate() {
                let value = weight * value;
                m.xx[i * n_columns..][..=i].iter_mut().zip(x).for_each(|(sum, other)| *sum += value * other);
                m.xy[i * n_targets..][..n_targets].iter_mut().zip(y).for_each(|(sum, y)| *sum += value * y);
            }
        }
        m.n_runs = 1.0;
        m
    }

    pub(super) fn add(&mut self, other: &Moments, sign: f64) {
        self.n_runs += sign;
        self.xx.iter_mut().zip(&other.xx).for_each(|(a, b)| *a += sign * b);
        self.xy.iter_mut().zip(&other.xy).for_each(|(a, b)| *a += sign * b);
    }

    /// Solves for the models of steps and of values.
    pub(super) fn solve(mut self, targets: &[usize]) -> Option<Coefficients> {
        let n = self.n_columns;
        if self.n_runs < 1.0 {
            return None;
        }
        for i in 0..n {
            for j in 0..=i {
                let value = self.xx[i * n + j] / self.n_runs + if i == j { RIDGE } else { 0.0 };
                (self.xx[i * n + j], self.xx[j * n + i]) = (value, value);
            }
        }
        let inverse = inverse(&self.xx, n)?;
        let mut steps = vec![0.0; n * self.n_targets];
        for i in 0..n {
            for j in 0..n {
                let factor = inverse[i * n + j] / self.n_runs;
                let row = &self.xy[j * self.n_targets..][..self.n_targets];
                steps[i * self.n_targets..][..self.n_targets]
                    .iter_mut()
                    .zip(row)
                    .for_each(|(s, y)| *s += factor * y);
            }
        }
        // The inverse holds the regression of each column on all others.
        let mut values = vec![0.0; n * self.n_targets];
        for (t, k) in targets.iter().enumerate() {
            let own = k + 1;
            for i in (0..n).filter(|i| *i != own) {
                values[i * self.n_targets + t] = -inverse[i * n + own] / inverse[own * n + own];
            }
        }
        Some(Coefficients { n_columns: n, steps, values })
    }
}

/// Models of all targets, [column, target].
#[derive(Debug)]
pub(super) struct Coefficients {
    n_columns: usize,
    steps: Vec<f64>,
    values: Vec<f64>,
}

impl Coefficients {
    pub(super) fn fit(&self, run: &Standardised, targets: &[usize]) -> Vec<[Fit; 2]> {
        let n_targets = targets.len();
        let mut sums = vec![[Sums::default(); 2]; n_targets];
        let (mut steps, mut values) = (vec![0.0; n_targets], vec![0.0; n_targets]);
        let rows = run.x.chunks_exact(self.n_columns).zip(run.steps.chunks_exact(n_targets));
        for (row, (x, y)) in rows.enumerate() {
            steps.fill(0.0);
            values.fill(0.0);
            for (i, x) in x.iter().enumerate() {
                let of = |model: &[f64], out: &mut [f64]| {
                    let model = &model[i * n_targets..][..n_targets];
                    out.iter_mut().zip(model).for_each(|(sum, b)| *sum += x * b);
                };
                of(&self.steps, &mut steps);
                of(&self.values, &mut values);
            }
            for (t, sums) in sums.iter_mut().enumerate() {
                sums[0].add(row, steps[t], y[t]);
                sums[1].add(row, values[t], x[targets[t] + 1]);
            }
        }
        // A step alone may be a contact, or a jump that another rule names; a value alone is neither.
        sums.iter().map(|[steps, values]| [steps.fit(steps.worst), values.fit(0.0)]).collect()
    }
}

/// Sums over the rows of one run.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    n: f64,
    expected: f64,
    found: f64,
    expected2: f64,
    both: f64,
    error2: f64,
    worst: f64,
    worst_row: usize,
}

impl Sums {
    pub(super) fn add(&mut self, row: usize, expected: f64, found: f64) {
        let error = (found - expected) * (found - expected);
        self.n += 1.0;
        self.expected += expected;
        self.found += found;
        self.expected2 += expected * expected;
        self.both += expected * found;
        self.error2 += error;
        if error > self.worst {
            (self.worst, self.worst_row) = (error, row);
        }
    }

    /// Returns the fit without an error of this square.
    fn fit(&self, left_out: f64) -> Fit {
        let n = self.n.max(1.0);
        let spread = self.expected2 - self.expected * self.expected / n;
        let plain_error = ((self.error2 - left_out).max(0.0) / n).sqrt();
        let together = self.both - self.expected * self.found / n;
        Fit {
            error: plain_error / (self.expected2 / n).sqrt().max(1.0),
            plain_error,
            bias: (self.found - self.expected) / n,
            gain: if spread > 0.0 { together / spread } else { 0.0 },
            worst_row: self.worst_row,
        }
    }
}

/// Inverts a positive definite matrix by Gauss-Jordan elimination.
fn inverse(matrix: &[f64], n: usize) -> Option<Vec<f64>> {
    let mut a = matrix.to_vec();
    let mut pivot_row = vec![0.0; n];
    for k in 0..n {
        let pivot = a[k * n + k];
        if !pivot.is_finite() || pivot <= 0.0 {
            return None;
        }
        a[k * n + k] = 1.0;
        a[k * n..][..n].iter_mut().for_each(|v| *v /= pivot);
        pivot_row.copy_from_slice(&a[k * n..][..n]);
        for i in (0..n).filter(|i| *i != k) {
            let row = &mut a[i * n..][..n];
            let factor = std::mem::take(&mut row[k]);
            row.iter_mut().zip(&pivot_row).for_each(|(v, p)| *v -= factor * p);
        }
    }
    Some(a)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_inverse_is_one() {
        let matrix = [4.0, 1.0, 0.5, 1.0, 3.0, -0.2, 0.5, -0.2, 2.0];
        let inverse = inverse(&matrix, 3).unwrap();
        for i in 0..3 {
            for j in 0..3 {
                let product: f64 = (0..3).map(|k| matrix[i * 3 + k] * inverse[k * 3 + j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-12);
            }
        }
    }
}
