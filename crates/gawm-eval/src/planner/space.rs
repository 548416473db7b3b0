//! Actions as the environment takes them and as the model sees them.

use gawm_sim::EnvironmentSpec;

/// The affine map between raw actions and standardised chunks, and the bounds of the environment.
#[derive(Debug, Clone, PartialEq)]
pub struct ActionSpace {
    /// What is subtracted from each raw dimension.
    pub mean: Vec<f64>,
    /// What each raw dimension is divided by.
    pub scale: Vec<f64>,
    /// Smallest raw value that has an effect of its own.
    pub low: Vec<f64>,
    /// Largest such value.
    pub high: Vec<f64>,
    /// Actions in a chunk.
    pub frameskip: usize,
}

impl ActionSpace {
    /// Returns the space of an environment with the given standardisation, (mean, scale) per dimension.
    ///
    /// # Panics
    /// If there is not one pair per action dimension.
    pub fn new(
        spec: &EnvironmentSpec,
        standardisation: impl IntoIterator<Item = (f64, f64)>,
        frameskip: usize,
    ) -> Self {
        let (mean, scale): (Vec<f64>, Vec<f64>) = standardisation.into_iter().unzip();
        assert_eq!(mean.len(), spec.action.len(), "one mean and scale per action dimension");
        let low = spec.action.iter().map(|axis| axis.low).collect();
        let high = spec.action.iter().map(|axis| axis.high).collect();
        ActionSpace { mean, scale, low, high, frameskip }
    }

    /// Returns the width of a raw action.
    pub fn action_width(&self) -> usize {
        self.mean.len()
    }

    /// Returns the width `A` of a chunk.
    pub fn chunk_width(&self) -> usize {
        self.mean.len() * self.frameskip
    }

    /// Returns the raw action of a standardised one.
    pub fn raw(&self, standardised: &[f32]) -> Vec<f32> {
        let dims = standardised.iter().zip(&self.scale).zip(&self.mean);
        dims.map(|((value, scale), mean)| (f64::from(*value) * scale + mean) as f32).collect()
    }

    /// Returns the standardised action of a raw one.
    pub fn standardised(&self, raw: &[f32]) -> Vec<f32> {
        let dims = raw.iter().zip(&self.scale).zip(&self.mean);
        dims.map(|((value, scale), mean)| ((f64::from(*value) - mean) / scale) as f32).collect()
    }

    /// Returns the bounds of a raw dimension of a chunk in standardised units.
    pub fn standardised_bounds(&self) -> Vec<(f32, f32)> {
        (0..self.chunk_width())
            .map(|column| {
                let dim = column % self.action_width();
                let place = |bound: f64| ((bound - self.mean[dim]) / self.scale[dim]) as f32;
                (place(self.low[dim]), place(self.high[dim]))
            })
            .collect()
    }
}
