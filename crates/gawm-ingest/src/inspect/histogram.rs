//! A histogram of durations with a bounded relative error and a bounded size.

/// Buckets per factor of two: quantiles are right within 1.1 %.
const BUCKETS_PER_OCTAVE: f64 = 64.0;
/// Buckets for 1 ns up to 2^63 ns, and one for 0.
const N_BUCKETS: usize = 63 * 64 + 2;

/// Counts durations in logarithmic buckets.
#[derive(Debug, Clone, Default)]
pub(super) struct Histogram {
    /// Empty until the first value.
    counts: Vec<u32>,
    n_values: u64,
}

impl Histogram {
    pub(super) fn add(&mut self, value_ns: u64) {
        if self.counts.is_empty() {
            self.counts = vec![0; N_BUCKETS];
        }
        let bucket = bucket_of(value_ns);
        self.counts[bucket] = self.counts[bucket].saturating_add(1);
        self.n_values += 1;
    }

    /// Returns the value below which the share `q` of the values lies, `None` without values.
    pub(super) fn quantile(&self, q: f64) -> Option<f64> {
        let rank = (q * self.n_values.checked_sub(1)? as f64).round() as u64;
        let mut n_before = 0;
        for (bucket, &count) in self.counts.iter().enumerate() {
            n_before += u64::from(count);
            if n_before > rank {
                return Some(value_of(bucket));
            }
        }
        None
    }

    /// Returns how many values are larger than `limit_ns`, to the accuracy of a bucket.
    pub(super) fn count_above(&self, limit_ns: f64) -> u64 {
        let above =
            |(bucket, &count): (usize, &u32)| if value_of(bucket) > limit_ns { u64::from(count) } else { 0 };
        self.counts.iter().enumerate().map(above).sum()
    }
}

fn bucket_of(value_ns: u64) -> usize {
    if value_ns == 0 {
        return 0;
    }
    let bucket = (value_ns as f64).log2() * BUCKETS_PER_OCTAVE;
    (bucket.round() as usize + 1).min(N_BUCKETS - 1)
}

fn value_of(bucket: usize) -> f64 {
    if bucket == 0 { 0.0 } else { ((bucket - 1) as f64 / BUCKETS_PER_OCTAVE).exp2() }
}

#[cfg(test)]
mod tests {
    use super::Histogram;

    #[test]
    fn quantiles_are_right_within_a_bucket() {
        let mut histogram = Histogram::default();
        assert_eq!(histogram.quantile(0.5), None);
        (1..=1001).for_each(|i| histogram.add(i * 10_000));
        let median = histogram.quantile(0.5).unwrap();
        assert!((median / 5_010_000.0 - 1.0).abs() < 0.011, "got {median}");
        assert_eq!(histogram.quantile(0.0).map(|v| (v / 1e4).round()), Some(1.0));
        let n_above = histogram.count_above(5_010_000.0);
        assert!((490..=510).contains(&n_above), "got {n_above}");
    }

    #[test]
    fn extremes_have_a_bucket() {
        let mut histogram = Histogram::default();
        histogram.add(0);
        histogram.add(u64::MAX);
        assert_eq!(histogram.quantile(0.0), Some(0.0));
        assert!(histogram.quantile(1.0).unwrap() > 9e18);
    }
}
