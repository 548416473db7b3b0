//! Robust statistics: medians and quantiles that a few bad values cannot move.

/// Most values that a quantile looks at; more are strided.
const MAX_QUANTILE_VALUES: usize = 8192;

/// Returns the `q`-quantile of the finite values (nearest rank), NaN without any.
pub(super) fn quantile(values: &[f64], q: f64) -> f64 {
    let stride = values.len().div_ceil(MAX_QUANTILE_VALUES).max(1);
    let mut sample: Vec<f64> = values.iter().step_by(stride).copied().filter(|v| v.is_finite()).collect();
    quantile_of(&mut sample, q)
}

/// As [`quantile`], reordering `values`, which are all finite.
pub(super) fn quantile_of(values: &mut [f64], q: f64) -> f64 {
    if values.is_empty() {
        return f64::NAN;
    }
    let rank = ((values.len() - 1) as f64 * q).round() as usize;
    *values.select_nth_unstable_by(rank, f64::total_cmp).1
}

/// Returns the median of the finite values, NaN without any.
pub(super) fn median(values: &[f64]) -> f64 {
    quantile(values, 0.5)
}

/// Returns the median and the standard deviation estimated from the median absolute deviation.
pub(super) fn centre_and_scale(values: &[f64]) -> (f64, f64) {
    let centre = median(values);
    let deviations: Vec<f64> = values.iter().map(|v| (v - centre).abs()).collect();
    // 1.4826 makes the median absolute deviation of a Gaussian its standard deviation.
    (centre, 1.4826 * median(&deviations))
}

/// Returns the median of five values.
pub(super) fn median5(mut v: [f64; 5]) -> f64 {
    let mut sort = |i: usize, j: usize| {
        if v[i] > v[j] {
            v.swap(i, j);
        }
    };
    sort(0, 1);
    sort(3, 4);
    sort(0, 3);
    sort(1, 4);
    sort(1, 2);
    sort(2, 3);
    sort(1, 2);
    v[2]
}

/// Running sums for the correlation and regression of `y` on `x`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Pair {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    yy: f64,
    xy: f64,
}

impl Pair {
    pub(super) fn add(&mut self, x: f64, y: f64) {
        if x.is_finite() && y.is_finite() {
            self.n += 1.0;
            self.x += x;
            self.y += y;
            self.xx += x * x;
            self.yy += y * y;
            self.xy += x * y;
        }
    }

    fn moments(&self) -> (f64, f64, f64) {
        let (vx, vy) = (self.xx - self.x * self.x / self.n, self.yy - self.y * self.y / self.n);
        (vx.max(0.0), vy.max(0.0), self.xy - self.x * self.y / self.n)
    }

    /// Returns Pearson's correlation, 0 where one side is constant.
    pub(super) fn correlation(&self) -> f64 {
        let (vx, vy, cxy) = self.moments();
        if self.n < 3.0 || vx <= 1e-12 * self.xx || vy <= 1e-12 * self.yy || vx == 0.0 || vy == 0.0 {
            0.0
        } else {
            cxy / (vx * vy).sqrt()
        }
    }

    /// Returns the ratio of the standard deviations, y over x, with the sign of the correlation.
    pub(super) fn scale(&self) -> f64 {
        let (vx, vy, cxy) = self.moments();
        if vx == 0.0 { 0.0 } else { (vy / vx).sqrt() * cxy.signum() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn medians_are_medians() {
        assert_eq!(median5([5.0, 1.0, 4.0, 2.0, 3.0]), 3.0);
        assert_eq!(median5([1.0, 1.0, 9.0, 9.0, 9.0]), 9.0);
        assert_eq!(median(&[3.0, f64::NAN, 1.0, 2.0]), 2.0);
        assert!(median(&[]).is_nan());
    }

    #[test]
    fn correlation_of_a_line_is_one() {
        let mut pair = Pair::default();
        (0..10).for_each(|i| pair.add(f64::from(i), 3.0 - 2.0 * f64::from(i)));
        assert!((pair.correlation() + 1.0).abs() < 1e-12);
        assert!((pair.scale() + 2.0).abs() < 1e-12);
    }
}
