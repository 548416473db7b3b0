//! Linear layers on all threads: `y = x W^T + b`, and gradients that go straight to a [`GradientSink`].
//!
//! Few rows (a predictor's) make products that only read the weight; these are computed transposed, so that the weight is
//! read where it lies, in stripes by different threads. Many rows are split over threads, against panels of the weight.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, DType, Device, Layout, Result, Shape, Tensor};
use rayon::prelude::*;

use crate::adapter::{GradientSink, contiguous, with_values};
use crate::gemm::{Epilogue, Lhs, Packed, Rhs, STORE, gemm};
use crate::norm;
use crate::profile::{Kind, span};

/// Rows up to which a product is computed transposed.
const FEW_ROWS: usize = 64;
/// Rows of a result that one thread computes at once: a multiple of every register tile.
const STRIPE: usize = 96;

/// Sizes of a linear layer's product.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinearShape {
    /// Rows of `x` and `y`.
    pub rows: usize,
    /// Columns of `y`.
    pub outputs: usize,
    /// Columns of `x`.
    pub inputs: usize,
}

impl LinearShape {
    /// Floating-point operations of one product.
    fn operations(&self) -> usize {
        2 * self.rows * self.outputs * self.inputs
    }

    /// Returns `x W^T + b`, [rows, outputs].
    ///
    /// # Panics
    ///
    /// If a slice has not the size of the shape.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        let LinearShape { rows, outputs, inputs } = *self;
        let epilogue = Epilogue { accumulate: false, bias };
        if rows <= FEW_ROWS {
            let mut packed = Packed::default();
            packed.fill(x, [inputs, rows], [1, inputs]);
            let columns = self.stripes(Kind::LinearForward, outputs, |first, count, out| {
                let a = Lhs { values: &weight[first * inputs..], row_stride: inputs, k_stride: 1 };
                gemm([count, rows, inputs], a, Rhs::Packed(&packed), out, rows, STORE);
            });
            let mut y = transposed(&columns, rows, outputs);
            if let Some(bias) = bias {
                y.chunks_exact_mut(outputs).for_each(|y| norm::add(bias, y));
            }
            return y;
        }
        let packed = Packed::of_transposed(weight, [outputs, inputs]);
        let mut y = vec![0.0; rows * outputs];
        let stripes = y.par_chunks_mut(STRIPE * outputs).zip(x.par_chunks(STRIPE * inputs));
        stripes.for_each(|(y, x)| {
            let a = Lhs { values: x, row_stride: inputs, k_stride: 1 };
            let sizes = [x.len() / inputs, outputs, inputs];
            span(Kind::LinearForward, 2 * x.len() * outputs, || {
                gemm(sizes, a, Rhs::Packed(&packed), y, outputs, epilogue);
            });
        });
        y
    }

    /// Returns the gradient of `x`, `dy W`, [rows, inputs].
    ///
    /// # Panics
    ///
    /// If a slice has not the size of the shape.
    pub fn input_gradient(&self, dy: &[f32], weight: &[f32]) -> Vec<f32> {
        let LinearShape { rows, outputs, inputs } = *self;
        if rows <= FEW_ROWS {
            let mut packed = Packed::default();
            packed.fill(dy, [outputs, rows], [1, outputs]);
            let columns = self.stripes(Kind::LinearInputGradient, inputs, |first, count, out| {
                let a = Lhs { values: &weight[first..], row_stride: 1, k_stride: inputs };
                gemm([count, rows, outputs], a, Rhs::Packed(&packed), out, rows, STORE);
            });
            return transposed(&columns, rows, inputs);
        }
        let mut dx = vec![0.0; rows * inputs];
        let stripes = dx.par_chunks_mut(STRIPE * inputs).zip(dy.par_chunks(STRIPE * outputs));
        stripes.for_each(|(dx, dy)| {
            let a = Lhs { values: dy, row_stride: outputs, k_stride: 1 };
            let b = Rhs::Rows { values: weight, stride: inputs };
            span(Kind::LinearInputGradient, 2 * dy.len() * inputs, || {
                gemm([dy.len() / outputs, inputs, outputs], a, b, dx, inputs, STORE);
            });
        });
        dx
    }

    /// Returns the gradient of the weight, `dy^T x`, [outputs, inputs].
    ///
    /// # Panics
    ///
    /// If a slice has not the size of the shape.
    pub fn weight_gradient(&self, dy: &[f32], x: &[f32]) -> Vec<f32> {
        let LinearShape { rows, outputs, inputs } = *self;
        let mut dw = vec![0.0; outputs * inputs];
        dw.par_chunks_mut(STRIPE * inputs).enumerate().for_each(|(stripe, dw)| {
            let a = Lhs { values: &dy[stripe * STRIPE..], row_stride: 1, k_stride: outputs };
            let b = Rhs::Rows { values: x, stride: inputs };
            span(Kind::LinearWeightGradient, 2 * dw.len() * rows, || {
                gemm([dw.len() / inputs, inputs, rows], a, b, dw, inputs, STORE);
            });
        });
        dw
    }

    /// Computes a result of `count` rows (of as many elements as `self.rows`) in stripes on all threads.
    fn stripes(&self, kind: Kind, count: usize, work: impl Fn(usize, usize, &mut [f32]) + Sync) -> Vec<f32> {
        let mut result = vec![0.0; count * self.rows];
        result.par_chunks_mut(STRIPE * self.rows).enumerate().for_each(|(stripe, out)| {
            let rows = out.len() / self.rows;
            let share = self.operations() / count * rows;
            span(kind, share, || work(stripe * STRIPE, rows, out));
        });
        result
    }
}

/// Turns `columns` [width, rows] into [rows, width].
fn transposed(columns: &[f32], rows: usize, width: usize) -> Vec<f32> {
    let mut result = vec![0.0; rows * width];
    for (row, result) in result.chunks_exact_mut(width).enumerate() {
        for (value, column) in result.iter_mut().zip(columns.chunks_exact(rows)) {
            *value = column[row];
        }
    }
    result
}

/// Whether [`linear`] takes tensors: contiguous f32 on the CPU, and parameters that are variables themselves.
pub fn takes(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> bool {
    let plain = |tensor: &Tensor| tensor.device().is_cpu() && tensor.dtype() == DType::F32;
    let parameter = |tensor: &Tensor| plain(tensor) && tensor.is_variable() && tensor.is_contiguous();
    plain(x) && x.elem_count() > 0 && parameter(weight) && bias.is_none_or(parameter)
}

/// `y = x W^T + b`: `x` `[rows, inputs]`, `weight` `[outputs, inputs]`, `bias` `[outputs]` to `[rows, outputs]`.
///
/// Where `sink` collects, gradients of weight and bias go there; else they follow candle's way.
///
/// # Errors
///
/// - if the shapes do not fit.
pub fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>, sink: &GradientSink) -> Result<Tensor> {
    let ((rows, inputs), (outputs, expected)) = (x.dims2()?, weight.dims2()?);
    if inputs != expected || bias.is_some_and(|bias| bias.dims() != [outputs]) {
        candle_core::bail!(
            "linear: expected rows of {expected} and a bias of {outputs}, got {:?} and {:?}",
            x.dims(),
            bias.map(Tensor::dims)
        );
    }
    let operation = Operation { shape: LinearShape { rows, outputs, inputs }, sink: sink.clone() };
    let x = x.contiguous()?;
    match bias {
        Some(bias) => x.apply_op3(weight, bias, operation),
        None => x.apply_op2(weight, operation),
    }
}

struct Operation {
    shape: LinearShape,
    sink: GradientSink,
}

impl Operation {
    fn forward(&self, x: &[f32], weight: &[f32], bias: Option<&[f32]>) -> (CpuStorage, Shape) {
        let LinearShape { rows, outputs, .. } = self.shape;
        (CpuStorage::F32(self.shape.forward(x, weight, bias)), (rows, outputs).into())
    }

    /// Returns the gradients of `x`, of the weight and of the bias, the latter two only where nobody collects them.
    fn backward(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: Option<&Tensor>,
        dy: &Tensor,
    ) -> Result<[Option<Tensor>; 3]> {
        let LinearShape { outputs, .. } = self.shape;
        let tensors = [x.clone(), weight.clone(), dy.contiguous()?];
        let (dx, dw, db) = with_values(&tensors, |values| {
            let &[x_values, weight, dy] = values else {
                candle_core::bail!("linear: expected three tensors")
            };
            let dx = x.track_op().then(|| self.shape.input_gradient(dy, weight));
            let dw = self.shape.weight_gradient(dy, x_values);
            let mut db = vec![0.0; outputs];
            if bias.is_some() {
                span(Kind::ColumnSums, 0, || norm::add_columns(dy, &mut db));
            }
            Ok((dx, dw, db))
        })?;
        let of = |values: Vec<f32>, like: &Tensor| Tensor::from_vec(values, like.shape(), &Device::Cpu);
        let dx = dx.map(|dx| of(dx, x)).transpose()?;
        let (dw, db) = (of(dw, weight)?, bias.map(|bias| of(db, bias)).transpose()?);
        if !self.sink.collects() {
            return Ok([dx, Some(dw), db]);
        }
        self.sink.put(weight, dw)?;
        if let (Some(bias), Some(db)) = (bias, db) {
            self.sink.put(bias, db)?;
        }
        Ok([dx, None, None])
    }
}

impl CustomOp2 for Operation {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        l1: &Layout,
        weight: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        Ok(self.forward(contiguous(x.as_slice()?, l1)?, contiguous(weight.as_slice()?, l2)?, None))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [dx, dw, _] = self.backward(x, weight, None, dy)?;
        Ok((dx, dw))
    }
}

impl CustomOp3 for Operation {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        l1: &Layout,
        weight: &CpuStorage,
        l2: &Layout,
        bias: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let bias = contiguous(bias.as_slice()?, l3)?;
        Ok(self.forward(contiguous(x.as_slice()?, l1)?, contiguous(weight.as_slice()?, l2)?, Some(bias)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [dx, dw, db] = self.backward(x, weight, Some(bias), dy)?;
        Ok((dx, dw, db))
    }
}
