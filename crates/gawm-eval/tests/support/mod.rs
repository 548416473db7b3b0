//! A TwoRoom dataset and a run on it, made in process: for the tests of the program and for an example.

use std::path::Path;

use gawm_dataset::{
    DatasetSpec, DatasetWriter, EpisodeInfo, ImageColumn, RecordingInfo, Rows, Trajectory, VectorColumn,
    WriteMode,
};
use gawm_eval::data::Data;
use gawm_eval::encode::fit_frame;
use gawm_eval::run::standardise;
use gawm_image::{Image, Pixels, encode_png};
use gawm_model::objective::StateRule;
use gawm_model::{
    AdamW, AdamWConfig, Clips, DataWidths, Device, Gradients, ModelConfig, Objectives, Pass, Stream, Tensor,
    WarmupCosine, WorldModel, checkpoint, losses, standardize_frames,
};
use gawm_schema::ContentHash;
use gawm_schema::batch::{
    Baselines, BatchLayout, BatchShape, ClipCounts, DatasetInfo, EncodedFeature, HELLO_VERSION, Hello,
    Sequence, StandardisedDimInfo,
};
use gawm_sim::two_room::ExpertConfig;
use gawm_sim::{Environment, Frame, TwoRoom, TwoRoomConfig, TwoRoomExpert};

pub(crate) const CAMERA: &str = "observation.images.camera";
const FRAMESKIP: usize = 5;

/// Anything that goes wrong ends a test or an example.
pub(crate) type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

/// What to train and for how long.
#[derive(Debug, Clone)]
pub(crate) struct Training {
    pub(crate) preset: String,
    pub(crate) objective: String,
    pub(crate) steps: u64,
    pub(crate) clips: usize,
    pub(crate) rate: f64,
    pub(crate) seed: u64,
}

/// Lets the expert act and writes what happens as a dataset, frames of `size` pixels.
pub(crate) fn write_dataset(
    folder: &Path,
    episodes: u64,
    seed: u64,
    size: usize,
    train_share: f64,
) -> Outcome<()> {
    let linear = |name: &str, role: &str, unit: &str| {
        format!(
            "[[features]]\nname = {name:?}\nrole = {role:?}\ndata = {{ type = \"vector\", dtype = \"float32\", parts = [\n{{ kind = \"linear\", dims = [{{ name = \"x\", unit = {unit:?}, source = \"/{role}:x\" }}, {{ name = \"y\", unit = {unit:?}, source = \"/{role}:y\" }}] }} ] }}\n"
        )
    };
    let schema = format!(
        "rate_hz = 10.0\nstreams = []\n{}{}[[features]]\nname = {CAMERA:?}\nrole = \"image\"\ndata = {{ type = \"image\", height = {size}, width = {size}, channels = 3 }}\n",
        linear("observation.state", "state", "px"),
        linear("action", "action", "1"),
    );
    let schema: gawm_schema::Schema = toml::from_str(&schema)?;
    let spec = DatasetSpec { train_share, ..DatasetSpec::new(schema.clone(), "", "test") };
    let mut writer = DatasetWriter::create(folder, spec, WriteMode::New)?;
    let content_hash = ContentHash::of(format!("two-room {episodes} {seed}").as_bytes());
    writer.begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: Default::default() })?;
    for episode in 0..episodes {
        writer.begin_episode(EpisodeInfo { task: "go".to_owned(), ..EpisodeInfo::default() })?;
        writer.write(Trajectory::try_new(&schema, rows(seed + episode, size)?)?)?;
        writer.end_episode()?;
    }
    writer.end_recording()?;
    writer.finish()?;
    Ok(())
}

fn rows(seed: u64, size: usize) -> Outcome<Rows> {
    let mut room = TwoRoom::new(TwoRoomConfig::default())?;
    room.reset(seed);
    let mut expert = TwoRoomExpert::new(ExpertConfig::default(), seed);
    let (mut states, mut actions, mut frames) = (Vec::new(), Vec::new(), Vec::new());
    let mut frame = Frame::default();
    for _ in 0..=100 {
        room.render(&mut frame);
        let image = Image::try_new(size as u32, size as u32, Pixels::Rgb8(fit_frame(&frame, (size, size))?))?;
        frames.push(encode_png(&image)?.into());
        states.extend(room.agent().map(f64::from));
        if room.success() {
            break;
        }
        let action = expert.act(room.config(), room.agent(), room.target());
        actions.extend(action.map(f64::from));
        room.advance(action);
    }
    // The last row has no action of its own: it repeats the one before, marked as not valid.
    let n = frames.len();
    let last: Vec<f64> = if n < 2 { vec![0.0; 2] } else { actions[2 * n - 4..2 * n - 2].to_vec() };
    actions.truncate(2 * n - 2);
    actions.extend(last);
    let mut action_valid = vec![true; n];
    action_valid[n - 1] = false;
    Ok(Rows {
        time_ns: (0..n as i64).map(|row| row * 100_000_000).collect(),
        vectors: vec![
            VectorColumn { values: states, valid: vec![true; n] },
            VectorColumn { values: actions, valid: action_valid },
        ],
        images: vec![ImageColumn { frames, valid: vec![true; n] }],
        ..Rows::default()
    })
}

/// Says of a dataset what loaders would say.
pub(crate) fn hello(data: &Path, size: usize) -> Outcome<Hello> {
    let meta: serde_json::Value = serde_json::from_slice(&std::fs::read(data.join("meta/gawm.json"))?)?;
    let hash = |value: &serde_json::Value| serde_json::from_value::<ContentHash>(value.clone());
    let feature = |column: &str, name: &str| -> Outcome<EncodedFeature> {
        let all = meta["standardisation"].as_array().ok_or("no standardisation")?;
        let found = all.iter().find(|one| one["column"] == column).ok_or("no such column")?;
        let dims = found["dims"].as_array().ok_or("no dims")?;
        // What TwoRoom has: actions from -1 to 1, positions in 224 pixels.
        let (unit, low, high) = if name == "action" { ("\"1\"", -1.0, 1.0) } else { ("\"px\"", 0.0, 224.0) };
        let dim = |dim: &serde_json::Value| -> Outcome<StandardisedDimInfo> {
            let mean = dim["mean"].as_f64().ok_or("no mean")?;
            let scale = dim["scale"].as_f64().ok_or("no scale")?;
            Ok(StandardisedDimInfo {
                name: dim["name"].as_str().ok_or("no name")?.to_owned(),
                feature: name.to_owned(),
                unit: serde_json::from_str(unit)?,
                mean,
                scale,
                is_constant: false,
                min: (low - mean) / scale,
                max: (high - mean) / scale,
            })
        };
        Ok(EncodedFeature {
            dims: dims.iter().map(dim).collect::<Outcome<_>>()?,
            fitted_on: "train".to_owned(),
            fitted_hash: hash(&found["fitted_on"]["hash"])?,
        })
    };
    let schema_hash = hash(&meta["schema_hash"])?;
    let shape = BatchShape {
        clips: 32,
        frames: 4,
        views: 1,
        height: size,
        width: size,
        channels: 3,
        action_width: 2 * FRAMESKIP,
        state_width: 2,
    };
    let path = data.file_name().ok_or("no name")?.to_string_lossy().into_owned();
    Ok(Hello {
        format_version: HELLO_VERSION,
        datasets: vec![DatasetInfo { path, content_hash: schema_hash, schema_hash, share: 1.0, rows: 1 }],
        schema_hash,
        shape,
        layout_hash: BatchLayout::try_new(shape)?.hash(),
        sequence: Sequence { total_steps: 1, validate_every: 0, validation_batches: 0, steps_per_epoch: 1 },
        ranks: 1,
        seed: 3072,
        compat: "repaired".to_owned(),
        frameskip: FRAMESKIP,
        history: 3,
        span: 16,
        rate_hz: 10.0,
        cameras: vec![CAMERA.to_owned()],
        state: feature("gawm.state", "observation.state")?,
        action: feature("gawm.action", "action")?,
        train: ClipCounts::default(),
        validation: ClipCounts::default(),
        baselines: Baselines { state_variance: vec![1.0; 2], action_variance: vec![1.0; 2] },
    })
}

/// Trains a model on the training episodes of a dataset and writes the folder of a run.
pub(crate) fn train(data: &Path, run: &Path, training: &Training, log: &dyn Fn(u64, f32)) -> Outcome<()> {
    let config = ModelConfig::preset(&training.preset)?;
    let size = config.image_size;
    let mut config = config;
    let objectives = Objectives::preset(&training.objective)?;
    objectives.configure(&mut config);
    let hello = hello(data, size)?;
    let model =
        WorldModel::new(config.resolve(DataWidths { action: 10, state: 2 })?, training.seed, &Device::Cpu)?;
    let mut optimizer = AdamW::new(AdamWConfig::default());
    let schedule = WarmupCosine::published(training.rate, training.steps.max(1));
    if training.steps > 0 {
        let clips = ClipSource::open(data, &hello, size)?;
        for step in 0..training.steps {
            let batch = clips.batch(training, step)?;
            let pass = Pass::train(training.seed, step);
            let losses = losses(&model, &batch, &objectives, &pass)?;
            let gradients = Gradients::of(&losses.total, model.parameters())?;
            optimizer.step(model.parameters(), &gradients, schedule.rate(step))?;
            log(step, losses.total.to_scalar()?);
        }
    }
    std::fs::create_dir_all(run.join("checkpoints"))?;
    std::fs::write(run.join("hello.json"), hello.to_json())?;
    let Training { objective, seed, .. } = training;
    let config = format!("[objectives]\npreset = {objective:?}\n[train]\nseed = {seed}\n");
    std::fs::write(run.join("config.toml"), config)?;
    let about = checkpoint::About { schema_hash: Some(hello.schema_hash.to_string()), ..Default::default() };
    checkpoint::save(&run.join("checkpoints/best.safetensors"), &model, &about, None)?;
    Ok(())
}

/// Frames, standardised states and actions of an episode.
type Decoded = (Vec<Vec<u8>>, Vec<f32>, Vec<f32>);

/// All training episodes in memory.
struct ClipSource {
    episodes: Vec<Decoded>,
    /// Episode and first row of each clip.
    clips: Vec<(usize, usize)>,
    size: usize,
}

impl ClipSource {
    fn open(path: &Path, hello: &Hello, size: usize) -> Outcome<ClipSource> {
        let data = Data::open(path, CAMERA, &hello.state, &hello.action, "observation.state")?;
        let (mut episodes, mut clips) = (Vec::new(), Vec::new());
        for episode in data.episodes.iter().filter(|episode| episode.split == "train") {
            let rows: Vec<usize> = (0..episode.n_rows).collect();
            let frames = data.frames(episode, &rows)?;
            let frames =
                frames.iter().map(|frame| fit_frame(frame, (size, size))).collect::<Result<_, _>>()?;
            let standard = |values: &[f64], dims: &[StandardisedDimInfo]| -> Vec<f32> {
                let mut values = values.to_vec();
                values.chunks_exact_mut(2).for_each(|row| standardise(row, dims));
                values.into_iter().map(|value| value as f32).collect()
            };
            // The chunk of the last frame leaves the clip and is never used; it repeats the one before.
            let starts = 0..episode.n_rows.saturating_sub(3 * FRAMESKIP);
            clips.extend(starts.map(|start| (episodes.len(), start)));
            let actions = standard(&episode.actions, &hello.action.dims);
            episodes.push((frames, standard(&episode.states, &hello.state.dims), actions));
        }
        Ok(ClipSource { episodes, clips, size })
    }

    fn batch(&self, training: &Training, step: u64) -> Outcome<Clips> {
        let mut stream = Stream::new(training.seed, "clips", step);
        let (mut pixels, mut actions, mut states) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..training.clips {
            let (episode, start) = self.clips[stream.below(self.clips.len() as u32) as usize];
            let (frames, all_states, all_actions) = &self.episodes[episode];
            for frame in 0..4 {
                let row = start + frame * FRAMESKIP;
                pixels.extend_from_slice(&frames[row]);
                states.extend_from_slice(&all_states[2 * row..2 * row + 2]);
                let first = if frame < 3 { row } else { row - FRAMESKIP };
                actions.extend_from_slice(&all_actions[2 * first..2 * (first + FRAMESKIP)]);
            }
        }
        let (n, size) = (training.clips, self.size);
        let device = Device::Cpu;
        let frames = Tensor::from_vec(pixels, (n, 4, size, size, 3), &device)?;
        let actions = Tensor::from_vec(actions, (n, 4, 10), &device)?;
        let states = Tensor::from_vec(states, (n, 4, 2), &device)?;
        Ok(Clips::try_new(standardize_frames(&frames)?, actions, states, None, &StateRule::default())?)
    }
}
