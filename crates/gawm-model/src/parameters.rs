//! The named store of weights and running statistics, and how each starts.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, Var};
use gawm_kernels::GradientSink;
use thiserror::Error;

use crate::random::Stream;

/// How a tensor starts, before training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// All zero.
    Zeros,
    /// All one.
    Ones,
    /// Normal with mean 0.
    Normal {
        /// Standard deviation.
        std: f64,
    },
    /// Normal with mean 0, redrawn while outside [-bound, bound].
    TruncatedNormal {
        /// Standard deviation before the cut.
        std: f64,
        /// Largest magnitude.
        bound: f64,
    },
    /// Uniform in [-bound, bound).
    Uniform {
        /// Largest magnitude.
        bound: f64,
    },
}

/// Shape, start and role of one tensor of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterSpec {
    /// Shape; empty for a scalar.
    pub shape: Vec<usize>,
    /// How it starts.
    pub init: Init,
    /// f32, or i64 for counters.
    pub dtype: DType,
    /// Whether the optimiser updates it; running statistics are not trainable.
    pub trainable: bool,
}

/// The tensors that a model has, by name. Modules add theirs; nothing is allocated.
pub type Specs = BTreeMap<String, ParameterSpec>;

/// Adds a trainable f32 tensor to `specs`.
pub(crate) fn weight(specs: &mut Specs, name: String, shape: &[usize], init: Init) {
    specs.insert(name, ParameterSpec { shape: shape.to_vec(), init, dtype: DType::F32, trainable: true });
}

/// Adds a tensor that the optimiser does not update to `specs`.
pub(crate) fn buffer(specs: &mut Specs, name: String, shape: &[usize], init: Init, dtype: DType) {
    specs.insert(name, ParameterSpec { shape: shape.to_vec(), init, dtype, trainable: false });
}

/// The tensors of a model by the names of the published `state_dict`.
///
/// Modules hold tensors that share storage with these, so that [`Parameters::set`] changes the model.
#[derive(Debug, Clone)]
pub struct Parameters {
    specs: Specs,
    variables: BTreeMap<String, Var>,
    sink: GradientSink,
}

/// Why a tensor cannot be taken as a parameter.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// The model has no tensor of this name.
    #[error("unknown tensor {name:?}: the model has none of this name")]
    Unknown {
        /// The name.
        name: String,
    },
    /// A tensor of the model was not given.
    #[error("missing tensor {name:?}: expected shape {expected:?}")]
    Missing {
        /// The name.
        name: String,
        /// Its shape in the model.
        expected: Vec<usize>,
    },
    /// The shapes differ.
    #[error("shape mismatch on {name:?}: expected {expected:?}, got {got:?}")]
    Shape {
        /// The name.
        name: String,
        /// Its shape in the model.
        expected: Vec<usize>,
        /// The shape given.
        got: Vec<usize>,
    },
    /// A value is NaN or infinite.
    #[error("non-finite value in {name:?}: expected finite numbers, got {got} at element {index}")]
    NonFinite {
        /// The tensor.
        name: String,
        /// Row-major position of the first such value.
        index: usize,
        /// The value.
        got: f32,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Parameters {
    /// Draws every tensor of `specs` from its own stream of `seed`, so that adding one changes no other.
    pub fn init(specs: &Specs, seed: u64, device: &Device) -> candle_core::Result<Parameters> {
        Parameters::create(specs, device, |name, spec| {
            let mut stream = Stream::new(seed, &format!("init/{name}"), 0);
            (0..spec.shape.iter().product()).map(|_| draw(&mut stream, spec.init)).collect()
        })
    }

    /// Makes every tensor of `specs` zero, to be filled by [`Parameters::set`].
    pub fn zeros(specs: &Specs, device: &Device) -> candle_core::Result<Parameters> {
        Parameters::create(specs, device, |_, spec| vec![0.0; spec.shape.iter().product()])
    }

    fn create(
        specs: &Specs,
        device: &Device,
        values: impl Fn(&str, &ParameterSpec) -> Vec<f32>,
    ) -> candle_core::Result<Parameters> {
        let mut variables = BTreeMap::new();
        for (name, spec) in specs {
            let tensor = Tensor::from_vec(values(name, spec), spec.shape.as_slice(), &Device::Cpu)?;
            let tensor = tensor.to_dtype(spec.dtype)?.to_device(device)?;
            variables.insert(name.clone(), Var::from_tensor(&tensor)?);
        }
        Ok(Parameters { specs: specs.clone(), variables, sink: GradientSink::default() })
    }

    /// Names, shapes and starts, sorted by name.
    pub fn specs(&self) -> &Specs {
        &self.specs
    }

    /// Returns the tensor of `name`, sharing storage.
    ///
    /// # Errors
    ///
    /// - if there is none: the specs and the modules disagree.
    pub fn get(&self, name: &str) -> candle_core::Result<Tensor> {
        Ok(self.variable(name)?.as_tensor().clone())
    }

    /// Returns the variable of `name`.
    pub(crate) fn variable(&self, name: &str) -> candle_core::Result<&Var> {
        self.variables.get(name).ok_or_else(|| candle_core::Error::CannotFindTensor { path: name.to_owned() })
    }

    /// Where fused operations put the gradients of these tensors; [`Gradients::of`](crate::Gradients::of) reads it.
    pub(crate) fn sink(&self) -> &GradientSink {
        &self.sink
    }

    /// Returns names and tensors, sorted by name; running statistics included.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.variables.iter().map(|(name, variable)| (name.as_str(), variable.as_tensor()))
    }

    /// Returns what the optimiser updates, sorted by name.
    pub fn trainable(&self) -> impl Iterator<Item = (&str, &Var)> {
        self.variables
            .iter()
            .filter(|(name, _)| self.specs[*name].trainable)
            .map(|(name, v)| (name.as_str(), v))
    }

    /// Number of trainable values.
    pub fn count(&self) -> usize {
        self.trainable().map(|(_, variable)| variable.elem_count()).sum()
    }

    /// Replaces the values of a tensor; dtype and device are converted.
    ///
    /// # Errors
    ///
    /// - [`ParameterError::Unknown`], [`ParameterError::Shape`]; the store is unchanged then.
    pub fn set(&self, name: &str, value: &Tensor) -> Result<(), ParameterError> {
        let spec = self.specs.get(name).ok_or_else(|| ParameterError::Unknown { name: name.to_owned() })?;
        if value.dims() != spec.shape {
            let (expected, got) = (spec.shape.clone(), value.dims().to_vec());
            return Err(ParameterError::Shape { name: name.to_owned(), expected, got });
        }
        let variable = self.variable(name)?;
        // `detach` and `force_contiguous`: the store must not keep another tensor's graph or share its storage.
        let value = value.to_dtype(spec.dtype)?.to_device(variable.device())?.detach().force_contiguous()?;
        Ok(variable.set(&value)?)
    }

    /// Copies all values, for comparisons and snapshots.
    pub fn snapshot(&self) -> candle_core::Result<BTreeMap<String, Tensor>> {
        self.iter().map(|(name, tensor)| Ok((name.to_owned(), tensor.detach().copy()?))).collect()
    }
}

fn draw(stream: &mut Stream, init: Init) -> f32 {
    match init {
        Init::Zeros => 0.0,
        Init::Ones => 1.0,
        Init::Normal { std } => (stream.normal() * std) as f32,
        Init::TruncatedNormal { std, bound } => loop {
            let value = stream.normal() * std;
            if value.abs() <= bound {
                return value as f32;
            }
        },
        Init::Uniform { bound } => ((2.0 * stream.uniform() - 1.0) * bound) as f32,
    }
}
