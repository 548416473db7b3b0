//! Fills slots.

use std::sync::atomic::{AtomicBool, Ordering};

use gawm_image::{ImageError, Limits, Pixels, decode, decode_rgb_into, resize, to_rgb8};
use gawm_schema::batch::{BatchShape, SectionsMut, SlotHeader};
use rayon::prelude::*;

use crate::cache::Cache;
use crate::clips;
use crate::error::LoadError;
use crate::index::Index;

/// Makes batches of an index.
#[derive(Debug)]
pub struct BatchMaker<'a> {
    index: &'a Index,
    cache: Option<Cache>,
    pool: Option<rayon::ThreadPool>,
    loader: u32,
    loaders: u32,
}

/// The part of a slot that one clip fills.
struct ClipMut<'a> {
    id: u64,
    frames: &'a mut [u8],
    actions: &'a mut [f32],
    states: &'a mut [f32],
    action_mask: &'a mut [u8],
    state_mask: &'a mut [u8],
    frame_mask: &'a mut [u8],
}

/// Memory that is used again for each clip.
#[derive(Debug, Default)]
struct Scratch {
    page: Vec<u8>,
}

impl<'a> BatchMaker<'a> {
    /// Prepares making the batches of loader `loader` of `loaders`, from the cache if there is one.
    ///
    /// # Errors
    /// [`LoadError::Io`] if the threads cannot be started.
    pub fn new(
        index: &'a Index,
        cache: Option<Cache>,
        loader: u32,
        loaders: u32,
    ) -> Result<BatchMaker<'a>, LoadError> {
        let pool = match index.config.threads {
            1 => None,
            threads => {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
                let failed = |e: rayon::ThreadPoolBuildError| std::io::Error::other(e.to_string());
                Some(pool.map_err(failed).map_err(LoadError::io("start threads for", "decoding".as_ref()))?)
            }
        };
        Ok(BatchMaker { index, cache, pool, loader, loaders })
    }

    /// Makes the n-th batch of the run in the bytes of a slot and returns its header, which is not written yet.
    ///
    /// Every byte of the sections of the batch's clips is written.
    ///
    /// # Errors
    /// - [`LoadError::Interrupted`] if `stop` was set before all clips were made
    /// - [`LoadError::Frame`], [`LoadError::Page`], [`LoadError::Io`] if a frame cannot be read
    /// - [`LoadError::Batch`] if the slot cannot hold the layout
    ///
    /// # Panics
    /// If the run has no n-th batch.
    pub fn fill(&self, n: u64, slot: &mut [u8], stop: &AtomicBool) -> Result<SlotHeader, LoadError> {
        let index = self.index;
        let batch = index.hello().sequence.batch(n).expect("the caller asks for batches of the run");
        let ids = index.clips_of(batch);
        let sections = SectionsMut::try_new(index.layout(), slot)?;
        for (slot_id, id) in sections.clip_ids.iter_mut().zip(&ids) {
            *slot_id = *id;
        }
        let mut clips = cut(index.layout().shape(), sections, &ids);
        let make = |scratch: &mut Scratch, clip: &mut ClipMut<'_>| {
            if stop.load(Ordering::Relaxed) {
                return Err(LoadError::Interrupted);
            }
            self.make_clip(clip, scratch)
        };
        match &self.pool {
            None => {
                let mut scratch = Scratch::default();
                clips.iter_mut().try_for_each(|clip| make(&mut scratch, clip))?;
            }
            Some(pool) => pool.install(|| {
                clips.par_iter_mut().try_for_each_init(Scratch::default, |scratch, clip| make(scratch, clip))
            })?,
        }
        Ok(SlotHeader {
            schema_hash: index.hello().schema_hash,
            stream_hash: index.stream_hash(),
            n,
            batch,
            loader: self.loader,
            loaders: self.loaders,
            rank: index.rank,
            ranks: index.hello().ranks,
            clips: ids.len(),
        })
    }

    fn make_clip(&self, clip: &mut ClipMut<'_>, scratch: &mut Scratch) -> Result<(), LoadError> {
        self.copy_numbers(clip);
        let index = self.index;
        let (dataset, first) = clips::parts(clip.id);
        let shape = index.layout().shape();
        let frames = clip.frames.chunks_exact_mut(shape.frame_bytes());
        for (at, out) in frames.enumerate() {
            let (t, view) = (at / shape.views, at % shape.views);
            let row = first + (t * index.config.frameskip) as u64;
            match &self.cache {
                Some(cache) => out.copy_from_slice(cache.frame(dataset, row, view)),
                None => read_frame(index, dataset, row, view, &mut scratch.page, out)?,
            }
        }
        Ok(())
    }

    fn copy_numbers(&self, clip: &mut ClipMut<'_>) {
        let config = &self.index.config;
        let (dataset, first) = clips::parts(clip.id);
        let rows = &self.index.sources[dataset].rows;
        let shape = self.index.layout().shape();
        let dims = shape.action_width / config.frameskip;
        let first = first as usize;
        let span = config.span();
        for t in 0..shape.frames {
            let offset = t * config.frameskip;
            let row = first + offset;
            let states = row * shape.state_width..(row + 1) * shape.state_width;
            clip.states[t * shape.state_width..][..shape.state_width]
                .copy_from_slice(&rows.states[states.clone()]);
            clip.state_mask[t * shape.state_width..][..shape.state_width]
                .copy_from_slice(&rows.state_valid[states]);
            let views = row * shape.views..(row + 1) * shape.views;
            clip.frame_mask[t * shape.views..][..shape.views].copy_from_slice(&rows.frame_valid[views]);
            // A chunk that reaches beyond the clip's span is not there: zeros, marked invalid.
            let chunk = &mut clip.actions[t * shape.action_width..][..shape.action_width];
            let is_there = offset + config.frameskip <= span;
            clip.action_mask[t] = u8::from(is_there && rows.are_actions_valid(row..row + config.frameskip));
            if is_there {
                chunk.copy_from_slice(&rows.actions[row * dims..(row + config.frameskip) * dims]);
            } else {
                chunk.fill(0.0);
            }
        }
    }
}

/// Cuts the sections of a slot into clips.
fn cut<'a>(shape: &BatchShape, sections: SectionsMut<'a>, ids: &[u64]) -> Vec<ClipMut<'a>> {
    let BatchShape { frames, views, action_width, state_width, .. } = *shape;
    let mut clip_frames = sections.frames.chunks_exact_mut(frames * views * shape.frame_bytes());
    let mut actions = sections.actions.chunks_exact_mut(frames * action_width);
    let mut states = Parts { rest: sections.states, size: frames * state_width };
    let mut action_mask = sections.action_mask.chunks_exact_mut(frames);
    let mut state_mask = Parts { rest: sections.state_mask, size: frames * state_width };
    let mut frame_mask = sections.frame_mask.chunks_exact_mut(frames * views);
    let mut clips = Vec::with_capacity(ids.len());
    for id in ids {
        let enough = "a batch has at most as many clips as its slot";
        clips.push(ClipMut {
            id: *id,
            frames: clip_frames.next().expect(enough),
            actions: actions.next().expect(enough),
            states: states.next(),
            action_mask: action_mask.next().expect(enough),
            state_mask: state_mask.next(),
            frame_mask: frame_mask.next().expect(enough),
        });
    }
    clips
}

/// Like `chunks_exact_mut`, which refuses chunks of size 0: a dataset may have no state.
struct Parts<'a, T> {
    rest: &'a mut [T],
    size: usize,
}

impl<'a, T> Parts<'a, T> {
    fn next(&mut self) -> &'a mut [T] {
        let (part, rest) = std::mem::take(&mut self.rest).split_at_mut(self.size);
        self.rest = rest;
        part
    }
}

/// Reads and decodes one frame into `out`, resized where it has another size.
pub(crate) fn read_frame(
    index: &Index,
    dataset: usize,
    row: u64,
    view: usize,
    page: &mut Vec<u8>,
    out: &mut [u8],
) -> Result<(), LoadError> {
    let source = &index.sources[dataset];
    let camera = &source.cameras[view];
    let shape = index.layout().shape();
    let bytes = source.frames.read(view, row, page)?;
    let from = [camera.spec.width, camera.spec.height];
    let to = [shape.width as u32, shape.height as u32];
    decode_frame(bytes, from, to, out).map_err(|source_error| LoadError::Frame {
        path: source.frames.path_of(row).to_owned(),
        camera: camera.name.clone(),
        row,
        source: source_error,
    })
}

/// Decodes an image of one size ([width, height]) into pixels of another, as Pillow resizes.
fn decode_frame(bytes: &[u8], from: [u32; 2], to: [u32; 2], out: &mut [u8]) -> Result<(), ImageError> {
    if from == to {
        return decode_rgb_into(bytes, to[0], to[1], out);
    }
    let limits = Limits { max_pixels: u64::from(from[0]) * u64::from(from[1]) };
    let image = to_rgb8(decode(bytes, &limits)?)?;
    if [image.width(), image.height()] != from {
        return Err(ImageError::Mismatch {
            expected_width: from[0],
            expected_height: from[1],
            width: image.width(),
            height: image.height(),
        });
    }
    match resize(&image, to[0], to[1])?.into_pixels() {
        Pixels::Rgb8(values) => out.copy_from_slice(&values),
        other => return Err(ImageError::Unsuitable { target: "rgb8", pixels: other.name() }),
    }
    Ok(())
}
