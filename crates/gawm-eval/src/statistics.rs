//! Intervals and tests for success rates, and the few moments that reports need. All in f64.

use serde::{Deserialize, Serialize};

/// Normal quantile of a two-sided 95 % interval.
pub const Z95: f64 = 1.959_963_984_540_054;

/// An interval of fractions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower bound.
    pub low: f64,
    /// Upper bound.
    pub high: f64,
}

/// Returns the 95 % Wilson score interval of `successes` out of `n`; 0 to 1 for `n` = 0.
pub fn wilson(successes: usize, n: usize) -> Interval {
    if n == 0 {
        return Interval { low: 0.0, high: 1.0 };
    }
    let (n, z2) = (n as f64, Z95 * Z95);
    let p = successes as f64 / n;
    let centre = p + z2 / (2.0 * n);
    let half = Z95 * (p * (1.0 - p) / n + z2 / (4.0 * n * n)).sqrt();
    let scale = 1.0 + z2 / n;
    Interval { low: ((centre - half) / scale).max(0.0), high: ((centre + half) / scale).min(1.0) }
}

/// How two solvers did on the same problems.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Pairs {
    /// Problems that both solve.
    pub both: usize,
    /// Problems that only the first solves.
    pub only_first: usize,
    /// Problems that only the second solves.
    pub only_second: usize,
    /// Problems that neither solves.
    pub neither: usize,
}

/// The difference of two success rates on the same problems.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairedDifference {
    /// The counts.
    pub pairs: Pairs,
    /// Rate of the first minus rate of the second.
    pub difference: f64,
    /// 95 % interval of the difference.
    pub interval: Interval,
    /// Two-sided exact McNemar test: the probability of a split as uneven or more, if both were equally good.
    pub p_value: f64,
}

/// Compares outcomes of two solvers on the same problems.
///
/// The interval is Newcombe's method 10 (Statistics in Medicine 17, 1998): Wilson bounds of both rates, joined with the
/// correlation of the pairs.
pub fn paired_difference(outcomes: impl IntoIterator<Item = (bool, bool)>) -> PairedDifference {
    let mut pairs = Pairs::default();
    for outcome in outcomes {
        match outcome {
            (true, true) => pairs.both += 1,
            (true, false) => pairs.only_first += 1,
            (false, true) => pairs.only_second += 1,
            (false, false) => pairs.neither += 1,
        }
    }
    let Pairs { both, only_first, only_second, neither } = pairs;
    let n = both + only_first + only_second + neither;
    if n == 0 {
        let interval = Interval { low: -1.0, high: 1.0 };
        return PairedDifference { pairs, difference: 0.0, interval, p_value: 1.0 };
    }
    let rate = |count: usize| count as f64 / n as f64;
    let (p1, p2) = (rate(both + only_first), rate(both + only_second));
    let (w1, w2) = (wilson(both + only_first, n), wilson(both + only_second, n));
    let phi = correlation(pairs);
    let join = |a: f64, b: f64| (a * a - 2.0 * phi * a * b + b * b).max(0.0).sqrt();
    let difference = p1 - p2;
    let interval = Interval {
        low: difference - join(p1 - w1.low, w2.high - p2),
        high: difference + join(w1.high - p1, p2 - w2.low),
    };
    PairedDifference { pairs, difference, interval, p_value: mcnemar(only_first, only_second) }
}

/// Newcombe's corrected correlation of paired outcomes; 0 where a margin is empty.
fn correlation(pairs: Pairs) -> f64 {
    let [a, b, c, d] = [pairs.both, pairs.only_first, pairs.only_second, pairs.neither].map(|n| n as f64);
    let product = (a + b) * (c + d) * (a + c) * (b + d);
    if product == 0.0 {
        return 0.0;
    }
    let excess = a * d - b * c;
    let half = (a + b + c + d) / 2.0;
    let corrected = if excess > half { excess - half } else { excess.min(0.0) };
    corrected / product.sqrt()
}

/// Two-sided exact binomial test that `b` and `c` come of equal chances.
fn mcnemar(b: usize, c: usize) -> f64 {
    let n = b + c;
    // Terms of the binomial distribution of n fair coins, in logarithms: they pass the smallest double at n = 1075.
    let mut log_term = -(n as f64) * std::f64::consts::LN_2;
    let mut sum = 0.0;
    for k in 0..=b.min(c) {
        sum += log_term.exp();
        log_term += ((n - k) as f64).ln() - ((k + 1) as f64).ln();
    }
    (2.0 * sum).min(1.0)
}

/// Returns mean and sample standard deviation (ddof 1; 0 for one value); `None` for no value.
pub fn mean_std(values: &[f64]) -> Option<(f64, f64)> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    match values.len() {
        0 => None,
        1 => Some((mean, 0.0)),
        _ => Some((mean, (squares / (n - 1.0)).sqrt())),
    }
}

/// Returns the middle of the values (the mean of the two middle ones); `None` for no value.
pub fn median(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    Some((sorted[last / 2] + sorted[last.div_ceil(2)]) / 2.0)
}

/// Returns Pearson's correlation; `None` where one side does not vary.
pub fn pearson(x: &[f64], y: &[f64]) -> Option<f64> {
    let (mx, _) = mean_std(x)?;
    let (my, _) = mean_std(y)?;
    let sum = |f: &dyn Fn(f64, f64) -> f64| x.iter().zip(y).map(|(x, y)| f(x - mx, y - my)).sum::<f64>();
    let (xx, yy, xy) = (sum(&|a, _| a * a), sum(&|_, b| b * b), sum(&|a, b| a * b));
    (xx > 0.0 && yy > 0.0).then(|| xy / (xx * yy).sqrt())
}

/// Returns Spearman's rank correlation (ties share their mean rank); `None` where one side does not vary.
pub fn spearman(x: &[f64], y: &[f64]) -> Option<f64> {
    pearson(&ranks(x), &ranks(y))
}

fn ranks(values: &[f64]) -> Vec<f64> {
    let mut order: Vec<usize> = (0..values.len()).collect();
    order.sort_by(|&a, &b| values[a].total_cmp(&values[b]));
    let mut ranks = vec![0.0; values.len()];
    let mut first = 0;
    for tied in order.chunk_by(|&a, &b| values[a] == values[b]) {
        for &index in tied {
            ranks[index] = first as f64 + (tied.len() - 1) as f64 / 2.0;
        }
        first += tied.len();
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(got: f64, expected: f64, tolerance: f64) {
        assert!((got - expected).abs() <= tolerance, "expected {expected}, got {got}");
    }

    #[test]
    fn wilson_has_its_closed_forms() {
        let z2 = Z95 * Z95;
        check(wilson(0, 10).high, z2 / (10.0 + z2), 1e-12);
        check(wilson(10, 10).low, 10.0 / (10.0 + z2), 1e-12);
        let half = wilson(25, 50);
        check(half.low + half.high, 1.0, 1e-12);
        check((half.high - half.low) / 2.0, Z95 / (2.0 * (50.0 + z2).sqrt()), 1e-12);
        // 81 of 263: the example of Newcombe (1998), 0.2553 to 0.3662.
        check(wilson(81, 263).low, 0.2553, 5e-5);
        check(wilson(81, 263).high, 0.3662, 5e-5);
        assert_eq!(wilson(0, 0), Interval { low: 0.0, high: 1.0 });
    }

    fn pairs(both: usize, first: usize, second: usize, neither: usize) -> PairedDifference {
        let repeat = |n, outcome| std::iter::repeat_n(outcome, n);
        paired_difference(
            repeat(both, (true, true))
                .chain(repeat(first, (true, false)))
                .chain(repeat(second, (false, true)))
                .chain(repeat(neither, (false, false))),
        )
    }

    #[test]
    fn paired_differences_are_newcombes() {
        // Table III of Newcombe (1998), method 10: 36, 12, 2, 0 of 50.
        let difference = pairs(36, 12, 2, 0);
        check(difference.difference, 0.2, 1e-12);
        check(difference.interval.low, 0.0569, 5e-5);
        check(difference.interval.high, 0.3404, 5e-5);
        let same = pairs(30, 0, 0, 20);
        check(same.interval.low + same.interval.high, 0.0, 1e-12);
        assert_eq!(same.p_value, 1.0);
    }

    #[test]
    fn mcnemar_is_a_fair_coin() {
        check(pairs(5, 4, 0, 1).p_value, 2.0 / 16.0, 1e-12);
        check(pairs(5, 5, 1, 1).p_value, 2.0 * 7.0 / 64.0, 1e-12);
        assert_eq!(pairs(5, 3, 3, 1).p_value, 1.0);
        assert!(pairs(0, 3000, 100, 0).p_value < 1e-300);
    }

    #[test]
    fn correlations() {
        let x = [1.0, 2.0, 3.0, 4.0];
        check(pearson(&x, &[3.0, 5.0, 7.0, 9.0]).unwrap(), 1.0, 1e-12);
        check(spearman(&x, &[1.0, 8.0, 27.0, 64.0]).unwrap(), 1.0, 1e-12);
        check(spearman(&[1.0, 1.0, 2.0], &[1.0, 1.0, 0.0]).unwrap(), -1.0, 1e-12);
        assert_eq!(pearson(&x, &[1.0; 4]), None);
        assert_eq!(
            (median(&[3.0, 1.0, 2.0]), median(&[1.0, 2.0]), median(&[])),
            (Some(2.0), Some(1.5), None)
        );
        let (mean, std) = mean_std(&[1.0, 3.0]).unwrap();
        check(mean, 2.0, 1e-12);
        check(std, 2f64.sqrt(), 1e-12);
    }
}
