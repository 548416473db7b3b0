//! A small network of rows, `Linear -> norm -> GELU -> Linear`, forward and backward in one operation.
//!
//! Projectors normalise each column over the batch, heads each row; everything else is the same. Between the products
//! every value is read and written once, and only the normalised values are kept for the backward pass.

use std::sync::{Arc, Mutex};

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Result, Shape, Tensor};

use crate::adapter::{GradientSink, contiguous, in_pool, is_parameter, is_plain, lock, with_values};
use crate::gelu::{gelu, gelu_backward};
use crate::linear::LinearShape;
use crate::norm;
use crate::profile::{Kind, span};
use crate::rows::{over_rows, sum_rows};

/// What the hidden values are normalised over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeadNorm {
    /// Each row over its columns.
    Layer,
    /// Each column over all rows: batch norm in training.
    Batch,
}

/// Sizes of a head.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeadShape {
    /// Rows of `x` and `y`.
    pub rows: usize,
    /// Columns of `x`.
    pub inputs: usize,
    /// Columns between the layers.
    pub hidden: usize,
    /// Columns of `y`.
    pub outputs: usize,
    /// What is normalised.
    pub norm: HeadNorm,
    /// Added to the variance.
    pub epsilon: f32,
}

/// Weight [hidden, inputs] and bias of the first layer, weight and bias of the norm, weight [outputs, hidden] and bias of
/// the last layer.
pub const HEAD_PARAMETERS: usize = 6;

/// What a forward pass keeps.
#[derive(Debug)]
pub struct HeadState {
    /// Normalised values, [rows, hidden].
    xhat: Vec<f32>,
    /// `1 / sqrt(var + epsilon)` of each row or column.
    rstd: Vec<f32>,
    /// Mean and biased variance of each column, of a batch norm.
    pub statistics: Option<[Vec<f32>; 2]>,
}

/// The gradients of a backward pass.
#[derive(Debug)]
pub struct HeadGradients {
    /// Of `x`, [rows, inputs].
    pub x: Vec<f32>,
    /// Of the parameters, in their order.
    pub parameters: [Vec<f32>; HEAD_PARAMETERS],
}

impl HeadShape {
    fn first(&self) -> LinearShape {
        LinearShape { rows: self.rows, outputs: self.hidden, inputs: self.inputs }
    }

    fn last(&self) -> LinearShape {
        LinearShape { rows: self.rows, outputs: self.outputs, inputs: self.hidden }
    }

    /// Returns `y` [rows, outputs] and what [`HeadShape::backward`] needs.
    ///
    /// # Panics
    ///
    /// If a slice has not the size of the shape.
    pub fn forward(&self, x: &[f32], parameters: [&[f32]; HEAD_PARAMETERS]) -> (Vec<f32>, HeadState) {
        let [first, first_bias, weight, bias, last, last_bias] = parameters;
        let state = self.normalize(self.first().forward(x, first, Some(first_bias)));
        let activated = self.activate(&state.xhat, weight, bias);
        let y = self.last().forward(&activated, last, Some(last_bias));
        (y, state)
    }

    /// Normalises the hidden values in place.
    fn normalize(&self, mut hidden: Vec<f32>) -> HeadState {
        let width = self.hidden;
        span(Kind::Norm, 0, || match self.norm {
            HeadNorm::Layer => {
                let (mut xhat, mut rstd) = (vec![0.0; hidden.len()], vec![0.0; self.rows]);
                norm::normalize(&hidden, width, self.epsilon, &mut xhat, &mut rstd);
                HeadState { xhat, rstd, statistics: None }
            }
            HeadNorm::Batch => {
                let inverse = 1.0 / self.rows as f32;
                let scaled = |mut sums: Vec<f32>| {
                    sums.iter_mut().for_each(|sum| *sum *= inverse);
                    sums
                };
                let mean = scaled(sum_rows(&hidden, width, norm::add_columns));
                over_rows(&mut hidden, width, |_, rows| norm::subtract_row(&mean, rows));
                let variance = scaled(sum_rows(&hidden, width, norm::add_squares));
                let rstd: Vec<f32> =
                    variance.iter().map(|variance| 1.0 / (variance + self.epsilon).sqrt()).collect();
                over_rows(&mut hidden, width, |_, rows| norm::multiply_row(&rstd, rows));
                HeadState { xhat: hidden, rstd, statistics: Some([mean, variance]) }
            }
        })
    }

    /// `gelu(xhat * weight + bias)`.
    fn activate(&self, xhat: &[f32], weight: &[f32], bias: &[f32]) -> Vec<f32> {
        let mut activated = vec![0.0; xhat.len()];
        over_rows(&mut activated, self.hidden, |first, rows| {
            let mut scaled = vec![0.0; rows.len()];
            span(Kind::Norm, 0, || {
                norm::scale_shift(&xhat[first * self.hidden..][..rows.len()], weight, bias, &mut scaled)
            });
            span(Kind::Gelu, 0, || gelu(&scaled, rows));
        });
        activated
    }

    /// Returns the gradients, given `dy` [rows, outputs], that of `y`.
    ///
    /// The other arguments are those of the forward pass that returned `state`.
    ///
    /// # Panics
    ///
    /// If a slice has not the size of the shape.
    pub fn backward(
        &self,
        x: &[f32],
        parameters: [&[f32]; HEAD_PARAMETERS],
        state: HeadState,
        dy: &[f32],
    ) -> HeadGradients {
        let [first, _, weight, bias, last, _] = parameters;
        let HeadState { xhat, rstd, .. } = state;
        let mut activated = vec![0.0; xhat.len()];
        let mut d_hidden = self.last().input_gradient(dy, last);
        let width = self.hidden;
        crate::rows::over_two(&mut d_hidden, &mut activated, width, |start, d_hidden, activated| {
            let mut scaled = vec![0.0; d_hidden.len()];
            span(Kind::Norm, 0, || {
                norm::scale_shift(&xhat[start * width..][..d_hidden.len()], weight, bias, &mut scaled)
            });
            span(Kind::Gelu, 0, || gelu_backward(&scaled, activated, d_hidden));
        });
        let d_last = self.last().weight_gradient(dy, &activated);
        let d_last_bias = column_sums(dy, self.outputs);
        let (d_weight, d_bias) = span(Kind::Norm, 0, || {
            let (mut d_weight, mut d_bias) = (vec![0.0; width], vec![0.0; width]);
            norm::scale_shift_backward(&d_hidden, &xhat, &mut d_weight, &mut d_bias);
            (d_weight, d_bias)
        });
        let d_hidden = span(Kind::Norm, 0, || {
            self.normalize_backward(d_hidden, &xhat, &rstd, weight, [&d_weight, &d_bias])
        });
        let d_first = self.first().weight_gradient(&d_hidden, x);
        let d_first_bias = column_sums(&d_hidden, width);
        let parameters = [d_first, d_first_bias, d_weight, d_bias, d_last, d_last_bias];
        HeadGradients { x: self.first().input_gradient(&d_hidden, first), parameters }
    }

    /// Returns the gradient of the values before the norm, given those of the values and of weight and bias after it.
    fn normalize_backward(
        &self,
        mut dy: Vec<f32>,
        xhat: &[f32],
        rstd: &[f32],
        weight: &[f32],
        [d_weight, d_bias]: [&[f32]; 2],
    ) -> Vec<f32> {
        match self.norm {
            HeadNorm::Layer => {
                let mut dx = vec![0.0; dy.len()];
                norm::normalize_backward(&mut dy, xhat, rstd, weight, &mut dx);
                dx
            }
            HeadNorm::Batch => {
                // The means over the batch of the gradient and of its product with xhat are those of bias and weight.
                let inverse = 1.0 / self.rows as f32;
                let scale: Vec<f32> = rstd.iter().zip(weight).map(|(rstd, weight)| rstd * weight).collect();
                let part = |sums: &[f32]| sums.iter().map(|sum| sum * inverse).collect::<Vec<f32>>();
                let (mean, along) = (part(d_bias), part(d_weight));
                over_rows(&mut dy, self.hidden, |first, rows| {
                    let xhat = &xhat[first * self.hidden..][..rows.len()];
                    norm::batch_backward(rows, xhat, &scale, &mean, &along);
                });
                dy
            }
        }
    }
}

/// The sum over rows of each column.
pub(crate) fn column_sums(dy: &[f32], width: usize) -> Vec<f32> {
    span(Kind::ColumnSums, 0, || {
        let mut sums = vec![0.0; width];
        norm::add_columns(dy, &mut sums);
        sums
    })
}

/// A head as a candle operation, whose parameters are tensors of a model.
#[derive(Debug, Clone)]
pub struct Head(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    parameters: [Tensor; HEAD_PARAMETERS],
    sink: GradientSink,
    norm: HeadNorm,
    epsilon: f32,
}

impl Head {
    /// Makes a head of parameters in the order of [`HEAD_PARAMETERS`], sharing their storage.
    pub fn new(
        parameters: [Tensor; HEAD_PARAMETERS],
        sink: GradientSink,
        norm: HeadNorm,
        epsilon: f64,
    ) -> Head {
        Head(Arc::new(Inner { parameters, sink, norm, epsilon: epsilon as f32 }))
    }

    /// Whether [`Head::forward`] computes this: rows of f32 on the CPU, and parameters that are variables there.
    pub fn takes(&self, x: &Tensor) -> bool {
        is_plain(x) && x.elem_count() > 0 && self.0.parameters.iter().all(is_parameter)
    }

    /// Maps rows [N, inputs] to [N, outputs]; of a batch norm also returns mean and biased variance of each hidden column.
    ///
    /// Gradients of the parameters go to the sink.
    ///
    /// # Errors
    ///
    /// - if the shapes do not fit.
    pub fn forward(&self, x: &Tensor) -> Result<(Tensor, Option<[Tensor; 2]>)> {
        let (rows, inputs) = x.dims2()?;
        let [first, first_bias, weight, bias, last, last_bias] = &self.0.parameters;
        let ((hidden, expected), (outputs, between)) = (first.dims2()?, last.dims2()?);
        let vectors = [first_bias, weight, bias].iter().all(|vector| vector.dims() == [hidden]);
        if inputs != expected || between != hidden || !vectors || last_bias.dims() != [outputs] {
            candle_core::bail!(
                "head: expected rows of {expected} and parameters of {hidden} hidden columns, got rows {:?} and {:?}",
                x.dims(),
                self.0.parameters.iter().map(Tensor::dims).collect::<Vec<_>>()
            );
        }
        let Inner { norm, epsilon, .. } = *self.0;
        let shape = HeadShape { rows, inputs, hidden, outputs, norm, epsilon };
        let statistics = Arc::new(Mutex::new(None));
        let operation = Operation {
            head: self.clone(),
            shape,
            state: Mutex::new(None),
            statistics: Arc::clone(&statistics),
        };
        let y = x.contiguous()?.apply_op1(operation)?;
        let statistics = lock(&statistics).take();
        let tensor = |values: Vec<f32>| Tensor::from_vec(values, hidden, &Device::Cpu);
        match statistics {
            Some([mean, variance]) => Ok((y, Some([tensor(mean)?, tensor(variance)?]))),
            None => Ok((y, None)),
        }
    }
}

/// Mean and biased variance of each column.
type Statistics = Arc<Mutex<Option<[Vec<f32>; 2]>>>;

/// One pass, and what its backward pass needs.
struct Operation {
    head: Head,
    shape: HeadShape,
    state: Mutex<Option<HeadState>>,
    statistics: Statistics,
}

impl Operation {
    fn run(&self, x: &[f32]) -> Result<(Vec<f32>, HeadState)> {
        with_values(&self.head.0.parameters, |parameters| {
            in_pool(|| Ok(self.shape.forward(x, ordered(parameters)?)))
        })
    }
}

/// The values of all parameters, in order.
fn ordered<'a>(parameters: &[&'a [f32]]) -> Result<[&'a [f32]; HEAD_PARAMETERS]> {
    match parameters.try_into() {
        Ok(parameters) => Ok(parameters),
        Err(_) => candle_core::bail!("head: expected {HEAD_PARAMETERS} parameters, got {}", parameters.len()),
    }
}

impl CustomOp1 for Operation {
    fn name(&self) -> &'static str {
        "head"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let (y, mut state) = self.run(contiguous(x.as_slice()?, layout)?)?;
        *lock(&self.statistics) = state.statistics.take();
        *lock(&self.state) = Some(state);
        Ok((CpuStorage::F32(y), (self.shape.rows, self.shape.outputs).into()))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let Inner { parameters, sink, .. } = &*self.head.0;
        let kept = lock(&self.state).take();
        let gradients = with_values(&[x.clone(), dy.contiguous()?], |values| {
            let state = match kept {
                Some(state) => state,
                None => self.run(values[0])?.1,
            };
            with_values(parameters, |parameters| {
                let parameters = ordered(parameters)?;
                in_pool(|| Ok(self.shape.backward(values[0], parameters, state, values[1])))
            })
        })?;
        for (parameter, gradient) in parameters.iter().zip(gradients.parameters) {
            sink.put(parameter, Tensor::from_vec(gradient, parameter.shape(), &Device::Cpu)?)?;
        }
        Ok(Some(Tensor::from_vec(gradients.x, x.shape(), &Device::Cpu)?))
    }
}
