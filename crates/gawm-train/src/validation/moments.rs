//! Sums in f64 on the host: spread and rank of latents, errors of single dims.

use gawm_model::{Result, Tensor};

use crate::metrics::DimReport;

/// First and second moments of latents.
#[derive(Debug, Clone, Default)]
pub(super) struct LatentMoments {
    rows: f64,
    sums: Vec<f64>,
    /// Sums of products, [D, D] row-major, lower triangle.
    products: Vec<f64>,
}

/// Spread of latents.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct LatentSummary {
    /// Variance, averaged over dims.
    pub(super) variance: f64,
    /// Standard deviation, averaged over dims.
    pub(super) mean_std: f64,
    /// `(sum e)^2 / sum e^2` over the eigenvalues of the covariance; 0 if nothing varies.
    pub(super) effective_rank: f64,
}

impl LatentMoments {
    /// Adds `z` [B, T, D]. Sync: waits for the device.
    pub(super) fn add(&mut self, z: &Tensor) -> Result<()> {
        let (b, t, d) = z.dims3()?;
        let values = z.contiguous()?.flatten_all()?.to_vec1::<f32>()?;
        self.sums.resize(d, 0.0);
        self.products.resize(d * d, 0.0);
        for row in values.chunks_exact(d) {
            for (i, &x) in row.iter().enumerate() {
                let x = f64::from(x);
                self.sums[i] += x;
                let products = &mut self.products[i * d..=i * d + i];
                products.iter_mut().zip(row).for_each(|(product, &y)| *product += x * f64::from(y));
            }
        }
        self.rows += (b * t) as f64;
        Ok(())
    }

    pub(super) fn summary(&self) -> LatentSummary {
        let d = self.sums.len();
        if d == 0 {
            return LatentSummary::default();
        }
        let covariance = |i: usize, j: usize| {
            self.products[i * d + j] / self.rows - self.sums[i] / self.rows * (self.sums[j] / self.rows)
        };
        // Sum and squared sum of the eigenvalues are trace and squared Frobenius norm.
        let (mut trace, mut squares, mut deviations) = (0.0, 0.0, 0.0);
        for i in 0..d {
            let variance = covariance(i, i).max(0.0);
            trace += variance;
            deviations += variance.sqrt();
            squares += variance * variance;
            squares += (0..i).map(|j| 2.0 * covariance(i, j).powi(2)).sum::<f64>();
        }
        let effective_rank = if squares > 0.0 { trace * trace / squares } else { 0.0 };
        LatentSummary { variance: trace / d as f64, mean_std: deviations / d as f64, effective_rank }
    }
}

/// Squared errors and variances of targets, by dim.
#[derive(Debug, Clone)]
pub(super) struct DimErrors {
    dims: Vec<DimSums>,
}

#[derive(Debug, Clone, Default)]
struct DimSums {
    name: String,
    count: f64,
    squared_error: f64,
    sum: f64,
    squares: f64,
}

impl DimErrors {
    pub(super) fn new(names: Vec<String>) -> DimErrors {
        let dim = |name| DimSums { name, ..DimSums::default() };
        DimErrors { dims: names.into_iter().map(dim).collect() }
    }

    /// Adds decoded and target values, row-major; value n belongs to dim n modulo their number.
    pub(super) fn add(&mut self, decoded: &[f32], targets: &[f32], counts: impl Fn(usize) -> bool) {
        let width = self.dims.len().max(1);
        for (index, (x, y)) in decoded.iter().zip(targets).enumerate() {
            if let Some(dim) = self.dims.get_mut(index % width)
                && counts(index)
            {
                let (x, y) = (f64::from(*x), f64::from(*y));
                dim.count += 1.0;
                dim.squared_error += (x - y) * (x - y);
                dim.sum += y;
                dim.squares += y * y;
            }
        }
    }

    /// The error of the best constant over all values that count.
    pub(super) fn mean_variance(&self) -> f64 {
        let count: f64 = self.dims.iter().map(|dim| dim.count).sum();
        let sum: f64 = self.dims.iter().map(|dim| dim.count * dim.variance()).sum();
        if count > 0.0 { sum / count } else { 0.0 }
    }

    /// The dims that were seen.
    pub(super) fn reports(&self) -> Vec<DimReport> {
        let seen = self.dims.iter().filter(|dim| dim.count > 0.0);
        let report = |dim: &DimSums| {
            let (error, variance) = (dim.squared_error / dim.count, dim.variance());
            let skill = if variance > 0.0 { 1.0 - error / variance } else { 0.0 };
            DimReport { name: dim.name.clone(), error, variance, skill }
        };
        seen.map(report).collect()
    }
}

impl DimSums {
    fn variance(&self) -> f64 {
        if self.count == 0.0 {
            return 0.0;
        }
        let mean = self.sum / self.count;
        (self.squares / self.count - mean * mean).max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use gawm_model::{Device, Stream};

    use super::*;

    fn summary(values: Vec<f32>, d: usize) -> LatentSummary {
        let z = Tensor::from_vec(values.clone(), (1, values.len() / d, d), &Device::Cpu).unwrap();
        let mut moments = LatentMoments::default();
        moments.add(&z).unwrap();
        moments.add(&z).unwrap(); // twice the same data: the same moments
        moments.summary()
    }

    #[test]
    fn independent_dims_have_full_rank_and_copies_rank_one() {
        let mut stream = Stream::new(1, "moments", 0);
        let normals = stream.normals(4 * 20_000);
        let independent = summary(normals.clone(), 4);
        // The standard error of a variance of 20000 normals is 0.01.
        assert!((independent.effective_rank - 4.0).abs() < 0.01, "{independent:?}");
        assert!((independent.variance - 1.0).abs() < 0.03 && (independent.mean_std - 1.0).abs() < 0.02);
        let copies = summary(normals.iter().flat_map(|x| [*x, 2.0 * x, -x]).collect(), 3);
        assert!((copies.effective_rank - 1.0).abs() < 1e-9, "{copies:?}");
        let constant = summary(vec![3.0; 40], 4);
        assert!(constant.mean_std < 1e-6, "{constant:?}");
    }

    #[test]
    fn errors_are_counted_by_dim_and_mask() {
        let mut errors = DimErrors::new(vec!["x".to_owned(), "y".to_owned(), "unseen".to_owned()]);
        let targets = [1.0, 10.0, 0.0, 3.0, f32::NAN, 0.0];
        errors.add(&[1.0, 11.0, 0.0, 5.0, 0.0, 0.0], &targets, |index| index % 3 != 2 && index != 4);
        let reports = errors.reports();
        assert_eq!(reports.len(), 2);
        assert_eq!((reports[0].error, reports[0].variance, reports[0].skill), (2.0, 1.0, -1.0));
        assert_eq!((reports[1].error, reports[1].variance), (1.0, 0.0));
        assert_eq!(errors.mean_variance(), 2.0 / 3.0);
    }
}
