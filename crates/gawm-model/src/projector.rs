//! The projectors: an MLP with batch norm, after the encoder and after the predictor.

use candle_core::Tensor;

use crate::Result;
use crate::layers::{BatchNorm, Linear, gelu};
use crate::parameters::{Parameters, Specs};
use crate::pass::Pass;

/// `Linear -> BatchNorm -> GELU -> Linear`.
#[derive(Debug, Clone)]
pub struct Projector {
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
            expand: Linear::load(parameters, &format!("{name}.net.0"))?,
            norm: BatchNorm::load(parameters, &format!("{name}.net.1"))?,
            contract: Linear::load(parameters, &format!("{name}.net.3"))?,
        })
    }

    /// Maps rows [N, inputs] to [N, outputs]. In training the batch statistics run over all N rows.
    pub fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let x = self.norm.forward(&self.expand.forward(x, pass)?, pass)?;
        self.contract.forward(&gelu(&x)?, pass)
    }
}
