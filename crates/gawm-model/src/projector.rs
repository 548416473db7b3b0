//! The projectors: an MLP with batch norm, after the encoder and after the predictor.

use candle_core::Tensor;
use gawm_kernels::head::{Head, HeadNorm};

use crate::Result;
use crate::layers::{BatchNorm, Linear, gelu};
use crate::parameters::{Parameters, Specs};
use crate::pass::Pass;

/// `Linear -> BatchNorm -> GELU -> Linear`.
#[derive(Debug, Clone)]
pub struct Projector {
    /// All of it in one operation, for training; the rest is the composed form of the same.
    fused: Head,
    expand: Linear,
    norm: BatchNorm,
    contract: Linear,
}

impl Projector {
    /// Adds the tensors under `name`.
    pub fn specs(specs: &mut Specs, name: &str, inputs: usize, hidden: usize, outputs: usize) {
        Linear::specs(specs, &format!("{name}.net.0"), inputs, hidden);
        BatchNorm::specs(specs, &format!("{name}.net.1"), hidden);
        Linear::specs(specs, &format!("{name}.net.3"), hidden, outputs);
    }

    /// Takes the tensors under `name` from the store.
    pub fn load(parameters: &Parameters, name: &str) -> Result<Projector> {
        Ok(Projector {
            fused: fused_head(parameters, name, HeadNorm::Batch, BatchNorm::EPSILON)?,
            expand: Linear::load(parameters, &format!("{name}.net.0"))?,
            norm: BatchNorm::load(parameters, &format!("{name}.net.1"))?,
            contract: Linear::load(parameters, &format!("{name}.net.3"))?,
        })
    }

    /// Maps rows [N, inputs] to [N, outputs]. In training the batch statistics run over all N rows.
    pub fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let rows = x.dim(0)?;
        if pass.trains_fused(x) && rows > 1 && self.fused.takes(x) {
            let (y, statistics) = self.fused.forward(x)?;
            if let Some([mean, variance]) = statistics {
                self.norm.track(&mean, &variance, rows)?;
            }
            return Ok(y); // [N, outputs]
        }
        self.forward_composed(x, pass)
    }

    /// [`Projector::forward`] in composed operations.
    fn forward_composed(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let x = self.norm.forward(&self.expand.forward(x, pass)?, pass)?;
        self.contract.forward(&gelu(&x)?, pass)
    }
}

/// Hands the parameters of `Linear -> norm -> GELU -> Linear` under `name` to the fused form of it.
pub(crate) fn fused_head(parameters: &Parameters, name: &str, norm: HeadNorm, epsilon: f64) -> Result<Head> {
    let tensor = |part: &str| parameters.get(&format!("{name}.net.{part}"));
    let tensors = [
        tensor("0.weight")?,
        tensor("0.bias")?,
        tensor("1.weight")?,
        tensor("1.bias")?,
        tensor("3.weight")?,
        tensor("3.bias")?,
    ];
    Ok(Head::new(tensors, parameters.sink().clone(), norm, epsilon))
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;
    use crate::random::Stream;

    #[test]
    fn fused_and_composed_projectors_agree_in_training() {
        for rows in [2, 3, 300] {
            let mut specs = Specs::new();
            Projector::specs(&mut specs, "p", 5, 70, 3);
            let x = Stream::new(1, "x", 0).normals(rows * 5);
            let x = Tensor::from_vec(x, (rows, 5), &Device::Cpu).unwrap();
            let run = |composed: bool| {
                let parameters = Parameters::init(&specs, 2, &Device::Cpu).unwrap();
                let projector = Projector::load(&parameters, "p").unwrap();
                let pass = Pass::train(0, 0);
                let y = match composed {
                    true => projector.forward_composed(&x, &pass),
                    false => projector.forward(&x, &pass),
                };
                let moved = ["running_mean", "running_var", "num_batches_tracked"].map(|name| {
                    parameters.get(&format!("p.net.1.{name}")).unwrap().to_dtype(DType::F32).unwrap()
                });
                let mut values = y.unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
                values.extend(moved.iter().flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap()));
                values
            };
            for (fused, composed) in run(false).iter().zip(run(true)) {
                assert!((fused - composed).abs() < 1e-5, "{rows} rows: {fused} {composed}");
            }
        }
    }

    #[test]
    fn a_single_row_is_refused_in_training() {
        let mut specs = Specs::new();
        Projector::specs(&mut specs, "p", 5, 7, 3);
        let projector = Projector::load(&Parameters::init(&specs, 2, &Device::Cpu).unwrap(), "p").unwrap();
        let x = Tensor::ones((1, 5), DType::F32, &Device::Cpu).unwrap();
        let error = projector.forward(&x, &Pass::train(0, 0)).unwrap_err().to_string();
        assert!(error.contains("at least 2 rows"), "{error}");
        assert!(projector.forward(&x, &Pass::eval()).is_ok());
    }
}
