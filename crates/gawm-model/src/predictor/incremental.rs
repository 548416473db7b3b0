//! The predictor token by token, for rollouts: what a window shares with the one before is not computed again.

use candle_core::{D, Tensor};

use super::{Block, Predictor, modulate};
use crate::Result;
use crate::layers::{attention, causal_mask, join_heads, silu, split_heads};
use crate::pass::Pass;

/// Keys and values, [B, heads, T, d], of the tokens that a window has so far; one pair per block.
#[derive(Debug, Clone, Default)]
pub struct Window {
    blocks: Vec<(Tensor, Tensor)>,
}

impl Window {
    /// Returns the number of tokens.
    fn len(&self) -> Result<usize> {
        self.blocks.first().map_or(Ok(0), |(k, _)| k.dim(2))
    }
}

impl Predictor {
    /// Computes what conditions each block, from action embeddings [B, T, D]: one tensor [B, T, 6 D] per block.
    ///
    /// It depends on the action alone, not on the place of its token in a window.
    pub fn modulations(&self, c: &Tensor, pass: &Pass) -> Result<Vec<Tensor>> {
        let c = silu(c)?;
        self.blocks.iter().map(|block| block.modulation.forward(&c, pass)).collect()
    }

    /// Appends tokens to a window and returns the output of the last, [B, 1, D]; without dropout.
    ///
    /// `z` [B, n, D] are the latents of the tokens, `modulations` [B, n, 6 D] what conditions them (one per block).
    /// Equal to the last output of [`Predictor::forward`] over the whole window, up to rounding: attention is causal and
    /// positions do not change while a window grows, so that earlier tokens are only their keys and values.
    pub fn extend(
        &self,
        window: &mut Window,
        z: &Tensor,
        modulations: &[Tensor],
        pass: &Pass,
    ) -> Result<Tensor> {
        let (_, n, _) = z.dims3()?;
        let before = window.len()?;
        let mut x = z.broadcast_add(&self.pos_embedding.narrow(1, before, n)?)?;
        let last_block = self.blocks.len() - 1;
        let mut grown = Vec::with_capacity(self.blocks.len());
        for (index, (block, modulation)) in self.blocks.iter().zip(modulations).enumerate() {
            let (next, kv) =
                block.extend(&x, modulation, window.blocks.get(index), index == last_block, pass)?;
            x = next;
            grown.push(kv);
        }
        window.blocks = grown;
        self.norm.forward(&x) // [B, 1, D]
    }
}

impl Block {
    /// One block over new tokens `x` [B, n, D]; `kept` are keys and values before them. Of the last block only the last
    /// token is wanted: the others end with their keys and values.
    fn extend(
        &self,
        x: &Tensor,
        modulation: &Tensor,
        kept: Option<&(Tensor, Tensor)>,
        only_last: bool,
        pass: &Pass,
    ) -> Result<(Tensor, (Tensor, Tensor))> {
        let parts = modulation.chunk(6, D::Minus1)?; // 6 x [B, n, D]
        let [shift1, scale1, gate1, shift2, scale2, gate2] = parts.as_slice() else {
            candle_core::bail!("modulation of {}: expected 6 parts, got {}", self.site, parts.len());
        };
        let n = x.dim(1)?;
        let qkv = self.to_qkv.forward(&self.attn_norm.forward(&modulate(x, shift1, scale1)?)?, pass)?;
        let qkv = qkv.chunk(3, D::Minus1)?; // 3 x [B, n, heads x d]
        let (mut k, mut v) = (split_heads(&qkv[1], self.heads)?, split_heads(&qkv[2], self.heads)?);
        if let Some((keys, values)) = kept {
            (k, v) = (Tensor::cat(&[keys, &k], 2)?, Tensor::cat(&[values, &v], 2)?); // [B, heads, T, d]
        }
        let first = if only_last { n - 1 } else { 0 };
        let wanted = |tensor: &Tensor| tensor.narrow(1, first, n - first);
        let q = split_heads(&wanted(&qkv[0])?.contiguous()?, self.heads)?;
        // One new token sees all before it; several see each other as far as they come first.
        let (t, rows) = (k.dim(2)?, n - first);
        let mask =
            if rows == 1 { None } else { Some(causal_mask(t, x.device())?.narrow(0, t - rows, rows)?) };
        let y = attention([&q, &k, &v], mask.as_ref(), pass, |p| Ok(p.clone()))?; // [B, heads, rows, d]
        let y = self.to_out.forward(&join_heads(&y)?, pass)?; // [B, rows, D]
        let x = (wanted(x)? + (wanted(gate1)? * y)?)?;
        let y = self.mlp(&modulate(&x, &wanted(shift2)?, &wanted(scale2)?)?, pass)?;
        Ok(((x + (wanted(gate2)? * y)?)?, (k, v)))
    }
}
