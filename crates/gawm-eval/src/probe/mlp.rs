//! A two-layer probe, trained with Adam on mini-batches; a function of data, options and seed.

use candle_core::{Device, Result, Tensor, Var};
use gawm_model::{Stream, permutation};

use super::{ProbeOptions, Scale};

/// Rows of a mini-batch.
const BATCH: usize = 256;
/// Fewest steps of the optimiser: a pass over few rows is no more than a handful of them.
const MIN_STEPS: usize = 1500;

/// Linear, ReLU, linear; all dims at once.
#[derive(Debug, Clone)]
pub(super) struct Mlp {
    parameters: [Var; 4],
    d: usize,
    /// Mean and standard deviation of the targets: what is fitted is standardised, whatever the unit of a dim.
    targets: Scale,
}

impl Mlp {
    /// Fits `y` [N, s] on `x` [N, d]; values without a target (NaN) have no weight.
    pub(super) fn fit(
        x: &[f32],
        y: &[f64],
        d: usize,
        s: usize,
        options: &ProbeOptions,
        seed: u64,
    ) -> Result<Mlp> {
        let device = Device::Cpu;
        let hidden = options.hidden.max(1);
        let init = |name: &str, rows: usize, columns: usize, fan_in: usize| {
            let scale = (2.0 / fan_in as f32).sqrt();
            let values = Stream::new(seed, &format!("probe/{name}"), 0).normals(rows * columns);
            let values: Vec<f32> = values.into_iter().map(|value| value * scale).collect();
            Var::from_vec(values, (rows, columns), &device)
        };
        let parameters = [
            init("first", d, hidden, d)?,
            Var::zeros((1, hidden), candle_core::DType::F32, &device)?,
            init("second", hidden, s, hidden)?,
            Var::zeros((1, s), candle_core::DType::F32, &device)?,
        ];
        let targets = Scale::fit(y.iter().copied(), s);
        let mlp = Mlp { parameters, d, targets };
        let n = x.len() / d;
        let mask: Vec<f32> = y.iter().map(|value| f32::from(u8::from(value.is_finite()))).collect();
        let mut y: Vec<f32> = y.iter().map(|value| *value as f32).collect();
        mlp.targets.apply(&mut y);
        y.iter_mut().filter(|value| !value.is_finite()).for_each(|value| *value = 0.0);
        let (x, y) = (Tensor::from_slice(x, (n, d), &device)?, Tensor::from_vec(y, (n, s), &device)?);
        let mask = Tensor::from_vec(mask, (n, s), &device)?;
        let mut adam = Adam::new(&mlp.parameters)?;
        let batches = n.div_ceil(BATCH).max(1);
        let epochs = options.epochs.max(MIN_STEPS.div_ceil(batches));
        let steps = epochs * batches;
        for epoch in 0..epochs {
            let order = permutation(&mut Stream::new(seed, "probe/order", epoch as u64), n as u32);
            for rows in order.chunks(BATCH) {
                let index = Tensor::from_slice(rows, rows.len(), &device)?;
                let pick = |tensor: &Tensor| tensor.index_select(&index, 0);
                let error = (mlp.forward(&pick(&x)?)? - pick(&y)?)?.sqr()?.mul(&pick(&mask)?)?.mean_all()?;
                let gradients = error.backward()?;
                // Half a cosine to zero, so that the last steps do not rattle.
                let progress = adam.step as f64 / steps.max(1) as f64;
                let rate = options.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
                adam.update(&mlp.parameters, &gradients, rate)?;
            }
        }
        Ok(mlp)
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let [first, first_bias, second, second_bias] = &self.parameters;
        let hidden = x.matmul(first)?.broadcast_add(first_bias)?.relu()?;
        hidden.matmul(second)?.broadcast_add(second_bias)
    }

    /// Reads `x` [N, d]; returns [N, s], row-major.
    pub(super) fn predict(&self, x: &[f32]) -> Result<Vec<f32>> {
        let n = x.len() / self.d;
        if n == 0 {
            return Ok(Vec::new());
        }
        let x = Tensor::from_slice(x, (n, self.d), &Device::Cpu)?;
        let mut y = self.forward(&x)?.flatten_all()?.to_vec1()?;
        self.targets.undo(&mut y);
        Ok(y)
    }
}

/// Adam without decay.
struct Adam {
    first: Vec<Tensor>,
    second: Vec<Tensor>,
    step: usize,
}

impl Adam {
    fn new(parameters: &[Var]) -> Result<Adam> {
        let zeros = || parameters.iter().map(|parameter| parameter.zeros_like()).collect::<Result<Vec<_>>>();
        Ok(Adam { first: zeros()?, second: zeros()?, step: 0 })
    }

    fn update(
        &mut self,
        parameters: &[Var],
        gradients: &candle_core::backprop::GradStore,
        rate: f64,
    ) -> Result<()> {
        self.step += 1;
        let corrections = [0.9f64, 0.999].map(|beta| 1.0 - beta.powf(self.step as f64));
        for (index, parameter) in parameters.iter().enumerate() {
            let Some(gradient) = gradients.get(parameter) else { continue };
            self.first[index] = ((&self.first[index] * 0.9)? + (gradient * 0.1)?)?;
            self.second[index] = ((&self.second[index] * 0.999)? + (gradient.sqr()? * 0.001)?)?;
            let root = ((&self.second[index] / corrections[1])?.sqrt()? + 1e-8)?;
            let change = ((&self.first[index] / corrections[0])? / root)?;
            parameter.set(&(parameter.as_tensor() - (change * rate)?)?)?;
        }
        Ok(())
    }
}
