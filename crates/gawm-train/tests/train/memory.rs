//! Batches in memory of a small world: a dot that goes where its actions say.

use std::ops::Deref;
use std::path::Path;

use gawm_model::{Device, Stream};
use gawm_schema::batch::{
    Baselines, BatchLayout, BatchShape, ClipCounts, DatasetInfo, EncodedFeature, HELLO_VERSION, Hello,
    SectionsMut, Sequence, SlotHeader, StandardisedDimInfo,
};
use gawm_schema::{ContentHash, Unit};
use gawm_train::config::Config;
use gawm_train::interrupt::Interrupt;
use gawm_train::output::Talk;
use gawm_train::run_folder::RunFolder;
use gawm_train::source::{BatchSource, SourceError};
use gawm_train::state::TrainState;
use gawm_train::trainer::{Outcome, TrainError, Trainer};

/// Side of a frame in pixels, as the micro model takes it.
const SIDE: usize = 16;

/// Reads a configuration for short runs of the micro model.
pub(crate) fn config(train: &str) -> Config {
    let text = format!(
        "[model]\npreset = \"micro\"\n[train]\nsteps = 12\nrate = 2e-3\nvalidate_every = 5\n\
         validation_batches = 2\ncheckpoint_every = 3\nlog_every = 1\ndevice = \"cpu\"\n{train}"
    );
    Config::parse("test", &text, &[]).unwrap()
}

/// What a loader of the small world would say.
pub(crate) fn hello(config: &Config) -> Hello {
    let shape = BatchShape {
        clips: 8,
        frames: 4,
        views: 1,
        height: SIDE,
        width: SIDE,
        channels: 3,
        action_width: 2,
        state_width: 2,
    };
    let feature = |names: [&str; 2]| EncodedFeature {
        dims: names.map(dim).to_vec(),
        fitted_on: "train".to_owned(),
        fitted_hash: ContentHash::of(b"episodes"),
    };
    Hello {
        format_version: HELLO_VERSION,
        datasets: vec![DatasetInfo {
            path: "world".to_owned(),
            content_hash: ContentHash::of(b"content"),
            schema_hash: ContentHash::of(b"schema"),
            share: 1.0,
            rows: 1000,
        }],
        schema_hash: ContentHash::of(b"schema"),
        shape,
        layout_hash: BatchLayout::try_new(shape).unwrap().hash(),
        sequence: Sequence {
            total_steps: config.train.steps,
            validate_every: config.train.validate_every,
            validation_batches: config.train.validation_batches,
            steps_per_epoch: 7,
        },
        ranks: 1,
        seed: 3072,
        compat: "repaired".to_owned(),
        frameskip: 1,
        history: 3,
        span: 4,
        rate_hz: 10.0,
        cameras: vec!["front".to_owned()],
        state: feature(["x", "y"]),
        action: feature(["vx", "vy"]),
        train: ClipCounts { episodes: 9, clips: 56, excluded: 0, short_episodes: 0 },
        validation: ClipCounts::default(),
        baselines: Baselines { state_variance: vec![1.0; 2], action_variance: vec![1.0; 2] },
    }
}

fn dim(name: &str) -> StandardisedDimInfo {
    StandardisedDimInfo {
        name: name.to_owned(),
        feature: "observation.state".to_owned(),
        unit: Unit("m".to_owned()),
        mean: 0.0,
        scale: 1.0,
        is_constant: false,
        min: -2.0,
        max: 2.0,
    }
}

/// Aligned bytes of one batch.
#[derive(Debug)]
pub(crate) struct MemorySlot {
    bytes: Vec<u8>,
    start: usize,
    length: usize,
}

impl Deref for MemorySlot {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[self.start..self.start + self.length]
    }
}

/// The batches of the small world; what the n-th one holds depends on n alone.
pub(crate) struct World {
    pub(crate) hello: Hello,
    /// Draws the clips of a batch.
    pub(crate) draw: fn(&BatchShape, u64, &mut SectionsMut<'_>),
    /// Changes a batch before it is given out.
    pub(crate) change: fn(u64, &mut SectionsMut<'_>),
    /// Sets the interrupt when this batch is asked for.
    pub(crate) interrupt_at: Option<(u64, Interrupt)>,
    /// What slots say about their position, relative to the truth.
    pub(crate) shift: u64,
}

impl World {
    pub(crate) fn new(hello: &Hello) -> World {
        World { hello: hello.clone(), draw: fill, change: |_, _| {}, interrupt_at: None, shift: 0 }
    }

    /// Makes the bytes of the n-th batch.
    pub(crate) fn slot(&self, n: u64) -> MemorySlot {
        let layout = self.hello.layout().unwrap();
        let length = layout.total_bytes();
        let mut bytes = vec![0; length + 64];
        let start = bytes.as_ptr().align_offset(64);
        let slot = &mut bytes[start..start + length];
        let mut sections = SectionsMut::try_new(&layout, slot).unwrap();
        (self.draw)(&self.hello.shape, n, &mut sections);
        (self.change)(n, &mut sections);
        let header = SlotHeader {
            schema_hash: self.hello.schema_hash,
            stream_hash: self.hello.stream_hash(),
            n: n + self.shift,
            batch: self.hello.sequence.batch(n).unwrap(),
            loader: 0,
            loaders: 1,
            rank: 0,
            ranks: 1,
            clips: self.hello.shape.clips,
        };
        header.write(&layout, slot);
        MemorySlot { bytes, start, length }
    }
}

/// Draws clips: a red dot of 3 x 3 pixels that moves by its action, at most two pixels a step.
fn fill(shape: &BatchShape, n: u64, sections: &mut SectionsMut<'_>) {
    let mut stream = Stream::new(5, "world", n);
    sections.action_mask.fill(1);
    sections.state_mask.fill(1);
    sections.frame_mask.fill(1);
    let pixels = shape.height * shape.width * 3;
    for clip in 0..shape.clips {
        sections.clip_ids[clip] = n * 100 + clip as u64;
        let mut place = [0; 2].map(|_| 5.0 + 6.0 * stream.uniform());
        for t in 0..shape.frames {
            let row = clip * shape.frames + t;
            let frame = &mut sections.frames[row * pixels..][..pixels];
            for dy in 0..3 {
                for dx in 0..3 {
                    let (x, y) = (place[0] as usize + dx - 1, place[1] as usize + dy - 1);
                    frame[(y * shape.width + x) * 3] = 255;
                }
            }
            for (axis, place) in place.iter_mut().enumerate() {
                sections.states[row * 2 + axis] = ((*place - 8.0) / 3.0) as f32;
                let velocity = 4.0 * stream.uniform() - 2.0;
                sections.actions[row * 2 + axis] = (velocity / 1.2) as f32;
                *place = (*place + velocity).clamp(1.0, SIDE as f64 - 2.0);
            }
        }
    }
}

impl BatchSource for World {
    type Slot = MemorySlot;

    fn next(&mut self, n: u64) -> Result<MemorySlot, SourceError> {
        if let Some((at, interrupt)) = &self.interrupt_at
            && *at == n
        {
            interrupt.set();
        }
        Ok(self.slot(n))
    }
}

/// Trains in `folder`, going on with what is there, and returns how it ended.
pub(crate) fn train(
    folder: &Path,
    config: &Config,
    world: &mut World,
    interrupt: &Interrupt,
) -> Result<(Outcome, Trainer), TrainError> {
    let device = Device::Cpu;
    let (folder, resumed) = if folder.join("config.toml").exists() {
        let folder = RunFolder::resume(folder, config)?;
        let resumed =
            folder.last().exists().then(|| TrainState::load(&folder.last(), &device)).transpose()?;
        (folder, resumed)
    } else {
        (RunFolder::create(folder, config)?, None)
    };
    let hello = world.hello.clone();
    let mut trainer = Trainer::new(config.clone(), hello, &device, folder, resumed, Talk::Quiet)?;
    let outcome = trainer.run(world, interrupt)?;
    Ok((outcome, trainer))
}

/// Trains a new run to its end.
pub(crate) fn finish(folder: &Path, config: &Config, world: &mut World) -> Trainer {
    let (outcome, trainer) = train(folder, config, world, &Interrupt::default()).unwrap();
    assert_eq!(outcome, Outcome::Finished);
    trainer
}
