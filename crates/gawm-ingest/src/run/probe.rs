//! Looks into a recording for what the schema needs: sizes of images, rate of reference ticks.

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gawm_schema::ImageSpec;

use super::RunError;
use super::bind::Binding;
use super::picture::Picture;
use super::plan::Plans;
use super::recording::OpenRecording;
use crate::contract::{CheckedContract, Clock, ContractError, StreamData, TickRule};
use crate::decode::SchemaLibrary;
use gawm_video::{PacketDecoder, VideoError};

/// Samples of the reference stream that its rate is measured from.
const RATE_SAMPLES: usize = 400;

/// What was found.
pub(crate) struct Probed {
    pub(crate) rate_hz: f64,
    pub(crate) sizes: BTreeMap<usize, ImageSpec>,
    /// The first image that its crop does not fit: stream, width, height, crop.
    misfit: Option<(usize, (u32, u32), [u32; 4])>,
    /// Image streams without a single image.
    pub(crate) without_size: Vec<usize>,
    /// Messages of image topics that were looked at.
    pub(crate) read: u64,
    pub(crate) first_loss: Option<String>,
}

/// Reads as many blocks as are needed.
pub(crate) fn probe(
    open: &OpenRecording,
    binding: &Binding,
    contract: &CheckedContract,
    library: &SchemaLibrary,
) -> Result<Probed, RunError> {
    let reference = match &contract.ticks {
        TickRule::Fixed { .. } => None,
        TickRule::Reference { stream } => binding.streams.iter().position(|bound| bound.name == *stream),
    };
    let rate_hz = match (&contract.ticks, contract.written.ticks.fps) {
        (TickRule::Fixed { rate_hz }, _) => Some(*rate_hz),
        (TickRule::Reference { .. }, _) => None,
    };
    let images: Vec<usize> = (0..binding.streams.len())
        .filter(|&stream| matches!(binding.streams[stream].rule.data, StreamData::Image(_)))
        .collect();
    let mut probed = Probed {
        rate_hz: rate_hz.unwrap_or(0.0),
        sizes: BTreeMap::new(),
        misfit: None,
        without_size: Vec::new(),
        read: 0,
        first_loss: None,
    };
    let plans = Plans::new(binding, &[], &[], library);
    let mut times: Vec<i64> = Vec::new();
    let mut videos: BTreeMap<usize, FirstFrame> = BTreeMap::new();
    // Broken off or not, what was found is found.
    let _: ControlFlow<()> = open.read(&plans, 1, |_, block| {
        for message in &block.messages {
            let topic = &plans.topics[message.topic];
            probed.read += u64::from(!topic.images.is_empty());
            if let (Some(loss), false) = (message.loss(), topic.images.is_empty()) {
                probed
                    .first_loss
                    .get_or_insert_with(|| format!("the first lost as {}: {}", loss.reason, loss.detail));
            }
            let picture = message.picture().map(|(picture, _)| picture);
            let decoded = picture.and_then(Picture::packet).map(|(format, data)| {
                videos.entry(message.topic).or_default().of(format, data).map_err(|error| {
                    let text = format!("the first lost as {}: {error}", error.reason());
                    probed.first_loss.get_or_insert(text);
                })
            });
            let picture = match &decoded {
                None => picture,
                Some(frame) => frame.as_ref().ok().and_then(Option::as_ref),
            };
            if let Some(picture) = picture {
                for &stream in &topic.images {
                    if let StreamData::Image(rule) = &binding.streams[stream].rule.data {
                        let size = picture.recorded_size();
                        let misfit = rule.spec.crop.filter(|crop| !fits(*crop, size));
                        probed.misfit = probed.misfit.or(misfit.map(|crop| (stream, size, crop)));
                        probed.sizes.entry(stream).or_insert_with(|| picture.size(&rule.spec));
                    }
                }
            }
            if let Some(stream) = reference.filter(|&stream| binding.streams[stream].topic == topic.topic) {
                let stamp = message.picture().and_then(|(_, stamp)| *stamp);
                let stamp = stamp.or(message.rows(&block.rows).iter().find_map(|row| row.stamp_ns));
                times.push(match binding.streams[stream].rule.clock {
                    Clock::Log => message.log_ns,
                    Clock::Publish => message.publish_ns,
                    _ => stamp.unwrap_or(message.publish_ns),
                });
            }
        }
        let has_rate = reference.is_none() || times.len() >= RATE_SAMPLES;
        if has_rate && images.iter().all(|stream| probed.sizes.contains_key(stream)) {
            return ControlFlow::Break(());
        }
        ControlFlow::Continue(())
    });
    if let Some((stream, (width, height), crop)) = probed.misfit {
        let bound = &binding.streams[stream];
        let (stream, topic) = (bound.name.clone(), bound.topic.clone());
        return Err(RunError::Crop { stream, topic, width, height, crop });
    }
    probed.without_size = images.into_iter().filter(|stream| !probed.sizes.contains_key(stream)).collect();
    if reference.is_some() {
        probed.rate_hz = reference_rate(contract, &mut times)?;
    }
    Ok(probed)
}

fn fits([x, y, width, height]: [u32; 4], (image_width, image_height): (u32, u32)) -> bool {
    x.checked_add(width).is_some_and(|right| right <= image_width)
        && y.checked_add(height).is_some_and(|bottom| bottom <= image_height)
}

/// Looks for the first frame of a video topic.
#[derive(Debug, Default)]
struct FirstFrame {
    decoder: Option<PacketDecoder>,
    n_packets: i64,
    found: Option<Picture>,
}

impl FirstFrame {
    /// Takes a packet; returns the first frame, once it is there.
    fn of(&mut self, format: &str, data: &[u8]) -> Result<Option<Picture>, VideoError> {
        if self.found.is_none() {
            if self.decoder.is_none() {
                self.decoder = Some(PacketDecoder::new(format)?);
            }
            self.n_packets += 1;
            let frames = self.decoder.as_mut().map(|decoder| decoder.push(self.n_packets, data));
            let frame = frames.transpose()?.and_then(|frames| frames.into_iter().next());
            self.found = frame.map(|(_, frame)| Picture::of_frame(frame));
        }
        Ok(self.found.clone())
    }
}

/// Returns the rate of reference ticks; over 1 % from an integer the contract must name one.
fn reference_rate(contract: &CheckedContract, times: &mut [i64]) -> Result<f64, RunError> {
    times.sort_unstable();
    let mut steps: Vec<i64> =
        times.windows(2).map(|pair| pair[1] - pair[0]).filter(|step| *step > 0).collect();
    steps.sort_unstable();
    let measured = steps.get(steps.len() / 2).map(|&step| 1e9 / step as f64);
    if let Some(fps) = contract.written.ticks.fps {
        return Ok(f64::from(fps));
    }
    let rate_hz = measured.unwrap_or(1.0);
    let nearest = rate_hz.round().max(1.0);
    if (nearest - rate_hz).abs() > 0.01 * rate_hz {
        return Err(RunError::Contract(ContractError::Value {
            file: contract.file.clone(),
            key: "ticks.fps".to_owned(),
            expected: format!("an integer to write to info.json: the reference stream has {rate_hz:.3} Hz"),
            got: "nothing".to_owned(),
            hint: format!("fps = {nearest} would be {:.1} % off", 100.0 * (nearest / rate_hz - 1.0)),
        }));
    }
    Ok(nearest)
}
