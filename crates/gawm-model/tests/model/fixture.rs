//! Small models and batches for the tests.

use std::collections::BTreeMap;

use gawm_model::objective::StateRule;
use gawm_model::{Clips, DataWidths, Device, ModelConfig, Stream, Tensor, WorldModel};

pub(crate) const WIDTHS: DataWidths = DataWidths { action: 4, state: 3 };

/// A micro model whose zero-initialised modulation is perturbed and whose encoder has weights of ordinary size, so that
/// every path carries signal and steps of finite differences are small against the weights.
pub(crate) fn model(seed: u64, change: impl FnOnce(&mut ModelConfig)) -> WorldModel {
    let mut config = ModelConfig::preset("micro").unwrap();
    change(&mut config);
    let model = WorldModel::new(config.resolve(WIDTHS).unwrap(), seed, &Device::Cpu).unwrap();
    for (name, tensor) in model.parameters().iter() {
        let small = name.starts_with("encoder.") && !name.contains("layernorm");
        if name.contains("adaLN") || small {
            let noise = normal(seed, name, tensor.dims());
            model.parameters().set(name, &(noise * 0.2).unwrap()).unwrap();
        }
    }
    model
}

/// Whether the gradient of a parameter is zero in exact arithmetic.
///
/// A constant added to all keys leaves the softmax alone; one added to all rows before a batch norm is subtracted there.
pub(crate) fn has_zero_gradient(name: &str) -> bool {
    let before_batch_norm = [
        "projector.net.0.bias",
        "pred_proj.net.0.bias",
        "encoder.layernorm.bias",
        "predictor.transformer.norm.bias",
    ];
    name.ends_with("k_proj.bias") || before_batch_norm.contains(&name)
}

/// Clips of `t` frames of noise at the size of the micro model.
pub(crate) fn clips(seed: u64, b: usize, t: usize) -> Clips {
    let draw = |name: &str, shape: &[usize]| normal(seed, name, shape);
    let rule = StateRule { supervised: None, velocity: vec![2] };
    let (actions, states) = (draw("actions", &[b, t, WIDTHS.action]), draw("states", &[b, t, WIDTHS.state]));
    Clips::try_new(draw("frames", &[b, t, 3, 16, 16]), actions, states, None, &rule).unwrap()
}

pub(crate) fn normal(seed: u64, name: &str, shape: &[usize]) -> Tensor {
    let values = Stream::new(seed, &format!("test/{name}"), 0).normals(shape.iter().product());
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// The bits of every tensor of a model.
pub(crate) fn bits(model: &WorldModel) -> BTreeMap<String, Vec<u64>> {
    let values = |tensor: &Tensor| {
        let tensor = tensor.to_dtype(gawm_model::DType::F64).unwrap();
        tensor.flatten_all().unwrap().to_vec1::<f64>().unwrap().into_iter().map(f64::to_bits).collect()
    };
    model.parameters().iter().map(|(name, tensor)| (name.to_owned(), values(tensor))).collect()
}
