//! The heads of training: G reads the physical state from latents, H the action between them.

use candle_core::{D, Tensor};
use gawm_kernels::head::{Head as FusedHead, HeadNorm};

use crate::Result;
use crate::config::{Architecture, InverseInput};
use crate::layers::{LayerNorm, Linear, gelu};
use crate::parameters::{Parameters, Specs};
use crate::pass::Pass;
use crate::projector::fused_head;

/// `Linear -> LayerNorm -> GELU -> Linear`.
#[derive(Debug, Clone)]
struct Head {
    /// All of it in one operation, for training; the rest is the composed form of the same.
    fused: FusedHead,
    expand: Linear,
    norm: LayerNorm,
    contract: Linear,
}

impl Head {
    const EPSILON: f64 = 1e-5;

    fn specs(specs: &mut Specs, name: &str, inputs: usize, hidden: usize, outputs: usize) {
        Linear::specs(specs, &format!("{name}.net.0"), inputs, hidden);
        LayerNorm::specs(specs, &format!("{name}.net.1"), hidden);
        Linear::specs(specs, &format!("{name}.net.3"), hidden, outputs);
    }

    fn load(parameters: &Parameters, name: &str) -> Result<Head> {
        Ok(Head {
            fused: fused_head(parameters, name, HeadNorm::Layer, Head::EPSILON)?,
            expand: Linear::load(parameters, &format!("{name}.net.0"))?,
            norm: LayerNorm::load(parameters, &format!("{name}.net.1"), Head::EPSILON)?,
            contract: Linear::load(parameters, &format!("{name}.net.3"))?,
        })
    }

    /// Maps [.., inputs] to [.., outputs].
    fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        if pass.trains_fused(x) && self.fused.takes(x) {
            let mut dims = x.dims().to_vec();
            let (y, _) = self.fused.forward(&x.flatten_to(D::Minus2)?)?;
            if let Some(last) = dims.last_mut() {
                *last = y.dim(1)?;
            }
            return y.reshape(dims); // [.., outputs]
        }
        self.forward_composed(x, pass)
    }

    /// [`Head::forward`] in composed operations.
    fn forward_composed(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let x = self.norm.forward(&self.expand.forward(x, pass)?)?;
        self.contract.forward(&gelu(&x)?, pass)
    }
}

/// G: the physical state of a frame, from its latent and the one before it.
#[derive(Debug, Clone)]
pub struct StateProbe(Head);

impl StateProbe {
    /// Adds the tensors under `state_probe`.
    pub fn specs(specs: &mut Specs, architecture: &Architecture) {
        let (config, widths) = (architecture.config(), architecture.widths());
        Head::specs(specs, "state_probe", 2 * config.latent_width, config.state_head_width, widths.state);
    }

    /// Takes the tensors under `state_probe` from the store.
    pub fn load(parameters: &Parameters) -> Result<StateProbe> {
        Ok(StateProbe(Head::load(parameters, "state_probe")?))
    }

    /// Reads the state of every frame: `G(z[t-1], z[t])`, and `G(z[0], z[0])` for the first. [B, T, D] to [B, T, S].
    pub fn forward(&self, z: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (_, t, _) = z.dims3()?;
        let previous = Tensor::cat(&[z.narrow(1, 0, 1)?, z.narrow(1, 0, t - 1)?], 1)?; // [B, T, D]
        self.0.forward(&Tensor::cat(&[&previous, z], D::Minus1)?, pass) // [B, T, S]
    }
}

/// H: the action chunk between two consecutive frames, from their latents.
#[derive(Debug, Clone)]
pub struct InverseDynamics {
    head: Head,
    input: InverseInput,
}

impl InverseDynamics {
    /// Adds the tensors under `idm_head`.
    pub fn specs(specs: &mut Specs, architecture: &Architecture) {
        let hidden = architecture.config().inverse_head_width;
        let (inputs, outputs) = (architecture.inverse_input_width(), architecture.widths().action);
        Head::specs(specs, "idm_head", inputs, hidden, outputs);
    }

    /// Takes the tensors under `idm_head` from the store.
    pub fn load(parameters: &Parameters, architecture: &Architecture) -> Result<InverseDynamics> {
        let input = architecture.config().inverse_input;
        Ok(InverseDynamics { head: Head::load(parameters, "idm_head")?, input })
    }

    /// Reads the chunk between each pair of frames: [B, T, D] to [B, T-1, A].
    pub fn forward(&self, z: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (_, t, _) = z.dims3()?;
        let (from, to) = (z.narrow(1, 0, t - 1)?, z.narrow(1, 1, t - 1)?); // [B, T-1, D]
        let input = match self.input {
            InverseInput::Pair => Tensor::cat(&[from, to], D::Minus1)?,
            InverseInput::PairReversed => Tensor::cat(&[to, from], D::Minus1)?,
            InverseInput::Difference => (to - from)?,
        };
        self.head.forward(&input, pass) // [B, T-1, A]
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::random::Stream;

    #[test]
    fn fused_and_composed_heads_agree() {
        let mut specs = Specs::new();
        Head::specs(&mut specs, "h", 6, 20, 3);
        let head = Head::load(&Parameters::init(&specs, 2, &Device::Cpu).unwrap(), "h").unwrap();
        for shape in [[1, 1, 6], [2, 3, 6], [300, 3, 6]] {
            let x = Stream::new(1, "x", 0).normals(shape.iter().product());
            let x = Tensor::from_vec(x, &shape, &Device::Cpu).unwrap();
            let fused = head.forward(&x, &Pass::train(0, 0)).unwrap();
            let composed = head.forward_composed(&x, &Pass::train(0, 0)).unwrap();
            assert_eq!(fused.dims(), [shape[0], shape[1], 3]);
            let worst =
                (fused - composed).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
            assert!(worst < 1e-5, "{shape:?}: {worst}");
        }
    }
}
