//! Layers from differentiable primitives: layer norm, softmax, attention, GELU, SiLU, batch norm; and linear layers, which
//! are candle's.
//!
//! candle's own `layer_norm`, `softmax_last_dim` and `Tensor::gelu` are fast and wrong for us: the first two have no
//! backward pass and end the gradient without an error, the third is the tanh approximation. A test compares every
//! function here with finite differences. Linear layers go through `gawm-kernels` where it takes them.

use candle_core::{D, DType, Device, Module as _, Tensor, Var};
use gawm_kernels::GradientSink;

use crate::Result;
use crate::parameters::{Init, Parameters, Specs, buffer, weight};
use crate::pass::{Pass, Precision};

/// `y = x W^T + b`.
#[derive(Debug, Clone)]
pub struct Linear {
    layer: candle_nn::Linear,
    sink: GradientSink,
}

impl Linear {
    /// Adds a layer with torch's default start: weight and bias uniform in +-1/sqrt(`inputs`).
    pub fn specs(specs: &mut Specs, name: &str, inputs: usize, outputs: usize) {
        let init = Init::Uniform { bound: 1.0 / (inputs as f64).sqrt() };
        weight(specs, format!("{name}.weight"), &[outputs, inputs], init);
        weight(specs, format!("{name}.bias"), &[outputs], init);
    }

    /// Adds a layer with the given start of its weight; the bias starts at zero.
    pub fn specs_with(specs: &mut Specs, name: &str, inputs: usize, outputs: usize, init: Init) {
        weight(specs, format!("{name}.weight"), &[outputs, inputs], init);
        weight(specs, format!("{name}.bias"), &[outputs], Init::Zeros);
    }

    /// Takes `name.weight` and, if there is one, `name.bias` from the store.
    pub fn load(parameters: &Parameters, name: &str) -> Result<Linear> {
        let bias = format!("{name}.bias");
        let bias = if parameters.specs().contains_key(&bias) { Some(parameters.get(&bias)?) } else { None };
        let weight = parameters.get(&format!("{name}.weight"))?;
        Ok(Linear { layer: candle_nn::Linear::new(weight, bias), sink: parameters.sink().clone() })
    }

    /// Makes a layer of a weight [outputs, inputs] and a bias `[outputs]`.
    pub fn new(weight: Tensor, bias: Option<Tensor>) -> Linear {
        Linear { layer: candle_nn::Linear::new(weight, bias), sink: GradientSink::default() }
    }

    /// Width of the results.
    pub fn outputs(&self) -> Result<usize> {
        self.layer.weight().dim(0)
    }

    /// Maps the last axis: [.., inputs] to [.., outputs].
    pub fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (weight, bias) = (self.layer.weight(), self.layer.bias());
        let (outputs, inputs) = weight.dims2()?;
        let mut dims = x.dims().to_vec();
        let rows = dims.iter().product::<usize>() / inputs;
        if let Some(last) = dims.last_mut() {
            *last = outputs;
        }
        // One product over all rows: candle would copy the weight for every leading index of what is not contiguous.
        let x = x.reshape((rows, inputs))?;
        let y = match pass.precision {
            Precision::F32 if gawm_kernels::linear::takes(&x, weight, bias) => {
                gawm_kernels::linear::linear(&x, weight, bias, &self.sink)?
            }
            Precision::F32 => self.layer.forward(&x)?,
            Precision::Bf16 => match (pass.matmul(&x, &weight.t()?)?, bias) {
                (y, Some(bias)) => y.broadcast_add(bias)?,
                (y, None) => y,
            },
        }; // [rows, outputs]
        y.reshape(dims) // [.., outputs]
    }
}

/// Layer normalisation over the last axis, with scale and shift.
#[derive(Debug, Clone)]
pub struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
    epsilon: f64,
}

impl LayerNorm {
    /// Adds a layer that starts as the plain normalisation.
    pub fn specs(specs: &mut Specs, name: &str, width: usize) {
        weight(specs, format!("{name}.weight"), &[width], Init::Ones);
        weight(specs, format!("{name}.bias"), &[width], Init::Zeros);
    }

    /// Takes `name.weight` and `name.bias` from the store.
    pub fn load(parameters: &Parameters, name: &str, epsilon: f64) -> Result<LayerNorm> {
        let weight = parameters.get(&format!("{name}.weight"))?;
        Ok(LayerNorm { weight, bias: parameters.get(&format!("{name}.bias"))?, epsilon })
    }

    /// Normalises the last axis of [.., W].
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        normalize(x, self.epsilon)?.broadcast_mul(&self.weight)?.broadcast_add(&self.bias)
    }
}

/// Returns `(x - mean) / sqrt(var + epsilon)` over the last axis, with the biased variance. Shape [.., W], kept.
pub fn normalize(x: &Tensor, epsilon: f64) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?; // [.., 1]
    centred.broadcast_div(&(variance + epsilon)?.sqrt()?)
}

/// Returns softmax over the last axis, kept in shape.
pub fn softmax(x: &Tensor) -> Result<Tensor> {
    // The maximum only guards against overflow; its gradient is zero, so it is not followed.
    let exponentials = x.broadcast_sub(&x.max_keepdim(D::Minus1)?.detach())?.exp()?;
    exponentials.broadcast_div(&exponentials.sum_keepdim(D::Minus1)?)
}

/// Returns the exact GELU, `x/2 (1 + erf(x / sqrt 2))`; not the tanh form.
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    x.gelu_erf()
}

/// Returns `x / (1 + exp(-x))`.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    x.silu()
}

/// Splits the last axis into heads: [N, T, heads x d] to [N, heads, T, d], contiguous.
pub fn split_heads(x: &Tensor, heads: usize) -> Result<Tensor> {
    let (n, t, inner) = x.dims3()?;
    x.reshape((n, t, heads, inner / heads))?.transpose(1, 2)?.contiguous() // [N, heads, T, d]
}

/// Joins heads again: [N, heads, T, d] to [N, T, heads x d].
pub fn join_heads(x: &Tensor) -> Result<Tensor> {
    let (n, heads, t, d) = x.dims4()?;
    x.transpose(1, 2)?.reshape((n, t, heads * d)) // [N, T, heads x d]
}

/// Scaled dot-product attention, `softmax(q k^T / sqrt(d) + mask) v`; `q`, `k`, `v` have shape [N, heads, T, d].
///
/// `mask` [T, T] is added to the scores. `drop` is applied to the attention probabilities.
pub fn attention(
    [q, k, v]: [&Tensor; 3],
    mask: Option<&Tensor>,
    pass: &Pass,
    drop: impl Fn(&Tensor) -> Result<Tensor>,
) -> Result<Tensor> {
    let scale = 1.0 / (q.dim(D::Minus1)? as f64).sqrt();
    let scores = (pass.matmul(q, &k.t()?)? * scale)?; // [N, heads, T, T]
    let scores = match mask {
        Some(mask) => scores.broadcast_add(mask)?,
        None => scores,
    };
    pass.matmul(&drop(&softmax(&scores)?)?, v) // [N, heads, T, d]
}

/// Returns the [T, T] mask with 0 where position i may see j <= i and minus infinity elsewhere.
pub fn causal_mask(t: usize, device: &Device) -> Result<Tensor> {
    let values: Vec<f32> =
        (0..t).flat_map(|i| (0..t).map(move |j| if j <= i { 0.0 } else { f32::NEG_INFINITY })).collect();
    Tensor::from_vec(values, (t, t), device)
}

/// Batch normalisation of rows, with running statistics.
#[derive(Debug, Clone)]
pub struct BatchNorm {
    name: String,
    weight: Tensor,
    bias: Tensor,
    running_mean: Var,
    running_var: Var,
    num_batches_tracked: Var,
}

impl BatchNorm {
    /// Added to the variance.
    pub(crate) const EPSILON: f64 = 1e-5;
    /// Share of a new batch in the running statistics.
    const MOMENTUM: f64 = 0.1;

    /// Adds a layer that starts as the plain normalisation, with running mean 0 and variance 1.
    pub fn specs(specs: &mut Specs, name: &str, width: usize) {
        weight(specs, format!("{name}.weight"), &[width], Init::Ones);
        weight(specs, format!("{name}.bias"), &[width], Init::Zeros);
        buffer(specs, format!("{name}.running_mean"), &[width], Init::Zeros, DType::F32);
        buffer(specs, format!("{name}.running_var"), &[width], Init::Ones, DType::F32);
        buffer(specs, format!("{name}.num_batches_tracked"), &[], Init::Zeros, DType::I64);
    }

    /// Takes the five tensors under `name` from the store.
    pub fn load(parameters: &Parameters, name: &str) -> Result<BatchNorm> {
        let variable = |which| parameters.variable(&format!("{name}.{which}")).cloned();
        Ok(BatchNorm {
            name: name.to_owned(),
            weight: parameters.get(&format!("{name}.weight"))?,
            bias: parameters.get(&format!("{name}.bias"))?,
            running_mean: variable("running_mean")?,
            running_var: variable("running_var")?,
            num_batches_tracked: variable("num_batches_tracked")?,
        })
    }

    /// Normalises each column of [rows, W].
    ///
    /// In training by the mean and biased variance of the batch, which also move the running statistics (with the
    /// unbiased variance); in evaluation by the running statistics.
    ///
    /// # Errors
    ///
    /// - in training with a single row, of which no variance can be taken.
    pub fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (rows, _) = x.dims2()?;
        let (centred, variance) = if pass.training {
            if rows < 2 {
                candle_core::bail!(
                    "batch norm {:?}: expected at least 2 rows in training, got {rows}",
                    self.name
                );
            }
            let mean = x.mean_keepdim(0)?; // [1, W]
            let centred = x.broadcast_sub(&mean)?;
            let variance = centred.sqr()?.mean_keepdim(0)?; // [1, W]
            self.track(&mean.squeeze(0)?.detach(), &variance.squeeze(0)?.detach(), rows)?;
            (centred, variance)
        } else {
            let centred = x.broadcast_sub(&self.running_mean.as_detached_tensor())?;
            (centred, self.running_var.as_detached_tensor())
        };
        let normalized = centred.broadcast_div(&(variance + BatchNorm::EPSILON)?.sqrt()?)?;
        normalized.broadcast_mul(&self.weight)?.broadcast_add(&self.bias)
    }

    /// Moves the running statistics towards those of a batch of `rows` rows. Shapes [W].
    pub(crate) fn track(&self, mean: &Tensor, biased_variance: &Tensor, rows: usize) -> Result<()> {
        let unbiased = (biased_variance * (rows as f64 / (rows as f64 - 1.0)))?;
        for (variable, new) in [(&self.running_mean, mean), (&self.running_var, &unbiased)] {
            let old = (variable.as_detached_tensor() * (1.0 - BatchNorm::MOMENTUM))?;
            variable.set(&(old + (new * BatchNorm::MOMENTUM)?)?)?;
        }
        let count = self.num_batches_tracked.as_detached_tensor();
        self.num_batches_tracked.set(&(&count + count.ones_like()?)?)
    }
}
