//! Keeps calibrations and attachments beside the dataset.

use std::collections::BTreeMap;

use gawm_dataset::{DatasetWriter, WriteError};
use serde_json::{Value, json};

use super::bind::Binding;
use super::recording::OpenRecording;
use crate::contract::{CheckedContract, ImageSpec, StreamData};
use crate::decode::{CameraInfo, CropRect};

/// Writes the calibration of each camera, as recorded and as crop and resize leave it, and the attachments of the log.
///
/// Returns warnings.
pub(crate) fn keep(
    contract: &CheckedContract,
    binding: &Binding,
    open: &OpenRecording,
    infos: &BTreeMap<String, CameraInfo>,
    writer: &mut DatasetWriter,
) -> Result<Vec<String>, WriteError> {
    let mut warnings = Vec::new();
    for stream in &binding.streams {
        let StreamData::Image(rule) = &stream.rule.data else { continue };
        let Some(topic) = &rule.spec.camera_info else { continue };
        match infos.get(topic) {
            Some(info) => {
                writer.add_calibration(&stream.feature, &calibration(&stream.feature, topic, info, &rule.spec))?;
            }
            None => warnings.push(format!("{}: no calibration on {topic:?}", stream.feature)),
        }
    }
    let spec = &contract.written.calibration;
    if !spec.attachments {
        return Ok(warnings);
    }
    for log in open.logs.iter().filter_map(super::Source::as_log) {
        for (index, attachment) in log.attachments().iter().enumerate() {
            if attachment.data_size > spec.max_attachment_bytes {
                warnings.push(format!(
                    "attachment {:?} has {} bytes, more than calibration.max_attachment_bytes, and is not kept",
                    attachment.name, attachment.data_size
                ));
                continue;
            }
            match log.read_attachment(index) {
                Ok(bytes) => {
                    let name = if attachment.name.chars().any(char::is_alphanumeric) { &attachment.name } else { "attachment" };
                    writer.add_attachment(name, &bytes)?;
                }
                Err(error) => warnings.push(format!("attachment {:?} is not kept: {error}", attachment.name)),
            }
        }
    }
    Ok(warnings)
}

fn calibration(feature: &str, topic: &str, info: &CameraInfo, rule: &ImageSpec) -> Value {
    let crop = rule.crop.map(|[x, y, width, height]| CropRect { x, y, width, height });
    let size = match (rule.resize, crop) {
        (Some([width, height]), _) => (width, height),
        (None, Some(crop)) => (crop.width, crop.height),
        (None, None) => (info.width, info.height),
    };
    let stored = info.crop_resize(crop, size.0, size.1);
    json!({
        "feature": feature,
        "topic": topic,
        "frame_id": info.frame_id,
        "distortion_model": info.distortion_model,
        "d": info.d,
        "stored": intrinsics(&stored),
        "recorded": intrinsics(info),
    })
}

fn intrinsics(info: &CameraInfo) -> Value {
    json!({ "width": info.width, "height": info.height, "k": info.k, "r": info.r, "p": info.p })
}
