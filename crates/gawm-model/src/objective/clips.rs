//! A batch of clips as the objectives see it.

use candle_core::{DType, Tensor};
use thiserror::Error;

/// A batch of clips: frames, action chunks, state targets and which of them count.
#[derive(Debug, Clone)]
pub struct Clips {
    /// Standardised frames [B, T, C, H, W], f32 (see [`standardize_frames`](crate::standardize_frames)).
    pub frames: Tensor,
    /// Standardised action chunks [B, T, A], f32; chunk t acts between frames t and t + 1.
    pub actions: Tensor,
    /// Standardised, encoded state targets [B, T, S], f32.
    pub states: Tensor,
    /// Which targets count, [B, T, S], u8: 0 where a value is missing or not supervised.
    pub state_mask: Tensor,
}

/// Which dims of the state target are supervised, and which are velocities.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct StateRule {
    /// Dims of the target that count; `None` means all.
    pub supervised: Option<Vec<usize>>,
    /// Dims that are velocities: not supervised at t = 0, where the head sees one frame twice.
    pub velocity: Vec<usize>,
}

/// Why tensors make no batch.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ClipsError {
    /// A tensor has the wrong shape.
    #[error("shape mismatch on clip {field}: expected {expected}, got {got:?}")]
    Shape {
        /// `frames`, `actions`, `states` or `valid`.
        field: &'static str,
        /// The expectation in words.
        expected: String,
        /// The shape given.
        got: Vec<usize>,
    },
    /// A rule names a dim that the state does not have.
    #[error("state rule names dim {dim}: expected one below {width}")]
    Dim {
        /// The dim named.
        dim: usize,
        /// Width of the state.
        width: usize,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Clips {
    /// Joins the tensors of a batch, checks their shapes and makes the mask of the state targets.
    ///
    /// `valid` [B, T, S], u8, marks the values that were recorded; without it all are. Actions and states become f32.
    ///
    /// # Errors
    ///
    /// - [`ClipsError::Shape`] if the shapes do not fit each other or a clip has fewer than two frames.
    /// - [`ClipsError::Dim`] if the rule names a dim beyond the state.
    pub fn try_new(
        frames: Tensor,
        actions: Tensor,
        states: Tensor,
        valid: Option<&Tensor>,
        rule: &StateRule,
    ) -> Result<Clips, ClipsError> {
        let shape = |field, expected: String, tensor: &Tensor| ClipsError::Shape {
            field,
            expected,
            got: tensor.dims().to_vec(),
        };
        let (b, t) = match *frames.dims() {
            [b, t, _, _, _] if t >= 2 => (b, t),
            _ => return Err(shape("frames", "[B, T >= 2, C, H, W]".to_owned(), &frames)),
        };
        for (field, tensor) in [("actions", &actions), ("states", &states)] {
            if tensor.rank() != 3 || tensor.dims()[..2] != [b, t] {
                return Err(shape(field, format!("[{b}, {t}, width]"), tensor));
            }
        }
        if let Some(valid) = valid
            && valid.dims() != states.dims()
        {
            return Err(shape("valid", format!("{:?}", states.dims()), valid));
        }
        let mut state_mask = rule.mask(b, t, states.dim(2)?, &states)?;
        if let Some(valid) = valid {
            state_mask = (state_mask * valid.to_dtype(DType::U8)?)?;
        }
        let (actions, states) = (actions.to_dtype(DType::F32)?, states.to_dtype(DType::F32)?);
        Ok(Clips { frames, actions, states, state_mask })
    }
}

impl StateRule {
    /// Returns the mask [B, T, S], u8, on the device of `like`.
    fn mask(&self, b: usize, t: usize, s: usize, like: &Tensor) -> Result<Tensor, ClipsError> {
        if let Some(&dim) = self.supervised.iter().flatten().chain(&self.velocity).find(|&&dim| dim >= s) {
            return Err(ClipsError::Dim { dim, width: s });
        }
        let counts = |t: usize, dim: usize| {
            let supervised = self.supervised.as_ref().is_none_or(|dims| dims.contains(&dim));
            u8::from(supervised && !(t == 0 && self.velocity.contains(&dim)))
        };
        let clip: Vec<u8> = (0..t).flat_map(|t| (0..s).map(move |dim| counts(t, dim))).collect();
        let mask = Tensor::from_vec(clip, (1, t, s), like.device())?;
        Ok(mask.broadcast_as((b, t, s))?.contiguous()?) // [B, T, S]
    }
}
