//! AdamW with global-norm clipping, and its state.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Shape, Tensor, Var};
use gawm_kernels::adamw::{AdamWJob, AdamWStep, adamw, squared_norm};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::Result;
use crate::parameters::{ParameterError, Parameters};

/// Settings of [`AdamW`]; the default is the published one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamWConfig {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Decoupled weight decay, times the rate.
    pub weight_decay: f64,
    /// What is decayed.
    pub decay: Decay,
    /// Gradients are scaled down to this global L2 norm.
    pub max_gradient_norm: f64,
}

/// Which parameters are decayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Decay {
    /// All, as published: biases, norms, tokens and position tables too.
    #[default]
    All,
    /// Matrices and convolution kernels only.
    Matrices,
}

impl Default for AdamWConfig {
    fn default() -> AdamWConfig {
        AdamWConfig {
            beta1: 0.9,
            beta2: 0.999,
            epsilon: 1e-8,
            weight_decay: 1e-3,
            decay: Decay::All,
            max_gradient_norm: 1.0,
        }
    }
}

impl Decay {
    /// Whether the tensor `name` with `rank` axes is decayed.
    fn applies(self, name: &str, rank: usize) -> bool {
        let token = name.ends_with("_token")
            || name.ends_with("position_embeddings")
            || name.ends_with("pos_embedding");
        self == Decay::All || (rank >= 2 && !token)
    }
}

/// The gradients of one loss, by parameter name.
#[derive(Debug, Clone)]
pub struct Gradients(BTreeMap<String, Tensor>);

impl Gradients {
    /// Runs the backward pass of a scalar `loss` and collects the gradients of `parameters`.
    ///
    /// A parameter that the loss does not reach has none.
    pub fn of(loss: &Tensor, parameters: &Parameters) -> Result<Gradients> {
        let (mut store, mut fused) = parameters.sink().collect(|| loss.backward())?;
        let mut gradients = BTreeMap::new();
        for (name, variable) in parameters.trainable() {
            let gradient =
                match (store.remove(variable.as_tensor()), fused.remove(&variable.as_tensor().id())) {
                    (Some(a), Some(b)) => Some((a + b)?),
                    (a, b) => a.or(b),
                };
            if let Some(gradient) = gradient {
                gradients.insert(name.to_owned(), gradient);
            }
        }
        Ok(Gradients(gradients))
    }

    /// Names and gradients, sorted by name.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.0.iter().map(|(name, gradient)| (name.as_str(), gradient))
    }

    /// The gradient of one parameter, if the loss reaches it.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.0.get(name)
    }

    /// Returns the L2 norm over all gradients together, a scalar on the device.
    pub fn norm(&self) -> Result<Tensor> {
        let device = match self.0.values().next() {
            Some(gradient) => gradient.device(),
            None => candle_core::bail!("expected at least one gradient to take the norm of, got none"),
        };
        if self.0.values().all(is_plain) {
            let norm = squared_norm(&self.0.values().collect::<Vec<_>>())?.sqrt();
            return Tensor::new(norm as f32, device);
        }
        let squares = self.0.values().map(|gradient| gradient.to_dtype(DType::F32)?.sqr()?.sum_all());
        Tensor::stack(&squares.collect::<Result<Vec<_>>>()?, 0)?.sum_all()?.sqrt()
    }
}

/// What one optimiser step did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// The learning rate.
    pub rate: f64,
    /// Global L2 norm of the gradients before clipping.
    pub gradient_norm: f64,
}

/// Why a step or its state is refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OptimizerError {
    /// The gradients are useless; nothing was updated.
    #[error("gradient norm is {got} at step {step}: expected a finite number")]
    NonFinite {
        /// Optimiser step, from 0.
        step: u64,
        /// The norm.
        got: f64,
    },
    /// No parameter has a gradient: the loss does not depend on the model.
    #[error("no gradients at step {step}: the loss reaches no parameter")]
    NoGradients {
        /// Optimiser step, from 0.
        step: u64,
    },
    /// A moment of a saved state does not fit.
    #[error("optimiser state: {0}")]
    State(ParameterError),
    /// A saved state has only one of the two moments of a parameter.
    #[error("optimiser state of {name:?}: expected both moments, got one")]
    HalfMoment {
        /// The parameter.
        name: String,
    },
    /// A second moment is negative.
    #[error("optimiser state of {name:?}: expected a second moment >= 0, got {got}")]
    NegativeMoment {
        /// The parameter.
        name: String,
        /// The smallest value.
        got: f32,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl From<ParameterError> for OptimizerError {
    fn from(error: ParameterError) -> OptimizerError {
        OptimizerError::State(error)
    }
}

/// First and second moment of a gradient, f32.
#[derive(Debug, Clone)]
enum Moments {
    /// Of a parameter on the CPU, updated in place.
    Host { shape: Shape, first: Vec<f32>, second: Vec<f32> },
    /// Of a parameter elsewhere.
    Device { first: Tensor, second: Tensor },
}

impl Moments {
    fn zeros(variable: &Var) -> Result<Moments> {
        if is_plain(variable.as_tensor()) {
            let zeros = vec![0.0; variable.elem_count()];
            let shape = variable.shape().clone();
            return Ok(Moments::Host { shape, first: zeros.clone(), second: zeros });
        }
        let zeros = variable.as_detached_tensor().to_dtype(DType::F32)?.zeros_like()?;
        Ok(Moments::Device { first: zeros.clone(), second: zeros })
    }

    /// Takes saved moments of the shape of `variable`.
    fn restore(variable: &Var, first: &Tensor, second: &Tensor) -> Result<Moments> {
        if is_plain(variable.as_tensor()) {
            let values = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
            let shape = variable.shape().clone();
            return Ok(Moments::Host { shape, first: values(first)?, second: values(second)? });
        }
        let device = variable.device();
        Ok(Moments::Device { first: first.to_device(device)?, second: second.to_device(device)? })
    }

    /// Returns copies of both.
    fn tensors(&self) -> (Tensor, Tensor) {
        match self {
            Moments::Host { shape, first, second } => {
                let copy = |values: &Vec<f32>| {
                    Tensor::from_slice(values, shape, &Device::Cpu)
                        .expect("moments have as many values as the shape that they were made for")
                };
                (copy(first), copy(second))
            }
            Moments::Device { first, second } => (first.clone(), second.clone()),
        }
    }
}

/// The update of [`adamw`] in composed operations, for any device.
fn composed_update(
    step: &AdamWStep,
    kept: f64,
    variable: &Var,
    gradient: &Tensor,
    (first, second): (&mut Tensor, &mut Tensor),
) -> Result<()> {
    let (beta1, beta2) = (f64::from(step.beta1), f64::from(step.beta2));
    let gradient = (gradient.to_dtype(DType::F32)? * f64::from(step.scale))?;
    *first = ((&*first * beta1)? + (&gradient * (1.0 - beta1))?)?;
    *second = ((&*second * beta2)? + (gradient.sqr()? * (1.0 - beta2))?)?;
    let denominator = ((second.sqrt()? * f64::from(step.root))? + f64::from(step.epsilon))?;
    let kept = (variable.as_detached_tensor() * kept)?;
    variable.set(&(kept - ((&*first / denominator)? * f64::from(step.size))?)?)
}

/// Whether fused operations take a tensor.
fn is_plain(tensor: &Tensor) -> bool {
    tensor.device().is_cpu() && tensor.dtype() == DType::F32 && tensor.is_contiguous()
}

/// AdamW with decoupled decay, as torch computes it.
///
/// ```text
/// g = clip(gradient)
/// p = p (1 - rate * decay);  m = b1 m + (1 - b1) g;  v = b2 v + (1 - b2) g^2
/// p = p - rate / (1 - b1^t) * m / (sqrt(v) / sqrt(1 - b2^t) + eps)
/// ```
///
/// A parameter without gradient is left alone, its decay included.
#[derive(Debug, Clone)]
pub struct AdamW {
    config: AdamWConfig,
    step: u64,
    moments: BTreeMap<String, Moments>,
}

impl AdamW {
    /// Starts with no moments.
    pub fn new(config: AdamWConfig) -> AdamW {
        AdamW { config, step: 0, moments: BTreeMap::new() }
    }

    /// Number of steps taken.
    pub fn step_count(&self) -> u64 {
        self.step
    }

    /// The settings.
    pub fn config(&self) -> &AdamWConfig {
        &self.config
    }

    /// Clips the gradients to the global norm and updates the parameters at `rate`. Sync: waits for the device.
    ///
    /// # Errors
    ///
    /// - [`OptimizerError::NonFinite`], [`OptimizerError::NoGradients`]: nothing is updated.
    pub fn step(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        rate: f64,
    ) -> Result<StepReport, OptimizerError> {
        if gradients.0.is_empty() {
            return Err(OptimizerError::NoGradients { step: self.step });
        }
        let gradient_norm = f64::from(gradients.norm()?.to_scalar::<f32>()?);
        if !gradient_norm.is_finite() {
            return Err(OptimizerError::NonFinite { step: self.step, got: gradient_norm });
        }
        let scale = (self.config.max_gradient_norm / (gradient_norm + 1e-6)).min(1.0);
        self.step += 1;
        self.update(parameters, gradients, scale, rate)?;
        Ok(StepReport { rate, gradient_norm })
    }

    /// Updates every parameter that has a gradient, and its moments.
    fn update(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        scale: f64,
        rate: f64,
    ) -> Result<()> {
        let mut updated = Vec::with_capacity(gradients.0.len());
        for (name, variable) in parameters.trainable() {
            if let Some(gradient) = gradients.get(name) {
                if !self.moments.contains_key(name) {
                    self.moments.insert(name.to_owned(), Moments::zeros(variable)?);
                }
                updated.push((name, variable, gradient.contiguous()?));
            }
        }
        let step = self.corrections(scale, rate);
        let decayed = 1.0 - rate * self.config.weight_decay;
        let mut moments: BTreeMap<&str, &mut Moments> =
            self.moments.iter_mut().map(|(name, moments)| (name.as_str(), moments)).collect();
        let mut jobs = Vec::with_capacity(updated.len());
        for (name, variable, gradient) in &updated {
            let kept = if self.config.decay.applies(name, variable.rank()) { decayed } else { 1.0 };
            match moments.remove(name) {
                Some(Moments::Host { first, second, .. }) => {
                    let (parameter, kept) = (variable.as_tensor(), kept as f32);
                    jobs.push(AdamWJob { parameter, gradient, first, second, kept });
                }
                Some(Moments::Device { first, second }) => {
                    composed_update(&step, kept, variable, gradient, (first, second))?;
                }
                None => {}
            }
        }
        adamw(jobs, &step)
    }

    /// The numbers of this step that hold for all parameters.
    fn corrections(&self, scale: f64, rate: f64) -> AdamWStep {
        let AdamWConfig { beta1, beta2, epsilon, .. } = self.config;
        let step = self.step.min(i32::MAX as u64) as i32;
        AdamWStep {
            beta1: beta1 as f32,
            beta2: beta2 as f32,
            epsilon: epsilon as f32,
            scale: scale as f32,
            size: (rate / (1.0 - beta1.powi(step))) as f32,
            root: (1.0 / (1.0 - beta2.powi(step)).sqrt()) as f32,
        }
    }

    /// Returns the moments under `first.NAME` and `second.NAME`; with [`AdamW::step_count`] they are the whole state.
    pub fn state(&self) -> BTreeMap<String, Tensor> {
        let tensors = self.moments.iter().flat_map(|(name, moments)| {
            let (first, second) = moments.tensors();
            [(format!("first.{name}"), first), (format!("second.{name}"), second)]
        });
        tensors.collect()
    }

    /// Makes an optimiser of a saved state.
    ///
    /// # Errors
    ///
    /// - [`OptimizerError::State`] for a moment of no parameter or of another shape, [`OptimizerError::HalfMoment`],
    ///   [`OptimizerError::NegativeMoment`].
    pub fn restore(
        config: AdamWConfig,
        step: u64,
        state: &BTreeMap<String, Tensor>,
        parameters: &Parameters,
    ) -> Result<AdamW, OptimizerError> {
        let trainable: BTreeMap<&str, &Var> = parameters.trainable().collect();
        let mut moments = BTreeMap::new();
        for key in state.keys() {
            let name = key.strip_prefix("first.").or_else(|| key.strip_prefix("second.")).unwrap_or(key);
            let Some(variable) = trainable.get(name) else {
                return Err(ParameterError::Unknown { name: key.clone() }.into());
            };
            let pair = (state.get(&format!("first.{name}")), state.get(&format!("second.{name}")));
            let (Some(first), Some(second)) = pair else {
                return Err(OptimizerError::HalfMoment { name: name.to_owned() });
            };
            for moment in [first, second] {
                if moment.dims() != variable.dims() {
                    let (expected, got) = (variable.dims().to_vec(), moment.dims().to_vec());
                    return Err(ParameterError::Shape { name: key.clone(), expected, got }.into());
                }
            }
            let smallest = second.min_all()?.to_scalar::<f32>()?;
            if smallest < 0.0 {
                return Err(OptimizerError::NegativeMoment { name: name.to_owned(), got: smallest });
            }
            moments.insert(name.to_owned(), Moments::restore(variable, first, second)?);
        }
        Ok(AdamW { config, step, moments })
    }
}
