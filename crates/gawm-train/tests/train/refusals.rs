//! What a run refuses, and what it leaves behind when it stops.

use gawm_model::{Clips, Device, Tensor, standardize_frames};
use gawm_schema::batch::{BatchLayout, Hello};
use gawm_train::batch::Uploader;
use gawm_train::config::Config;
use gawm_train::interrupt::Interrupt;
use gawm_train::run_folder::{RunFolder, RunFolderError};
use gawm_train::source::{Expected, SourceError};
use gawm_train::state::ResumeError;
use gawm_train::step::StepError;
use gawm_train::trainer::TrainError;

use crate::memory::{World, config, finish, hello, train};

fn error(config: &Config, world: &mut World) -> TrainError {
    let folder = tempfile::tempdir().unwrap();
    train(folder.path(), config, world, &Interrupt::default()).map(|(outcome, _)| outcome).unwrap_err()
}

#[test]
fn a_loss_that_is_no_number_stops_with_everything_needed_to_find_out() {
    let folder = tempfile::tempdir().unwrap();
    let config = config("");
    let mut world = World::new(&hello(&config));
    // Batch 8 is training step 6, behind five steps and a validation of two batches; step 3 was saved.
    world.change = |n, sections| {
        if n == 8 {
            sections.actions[3] = f32::NAN;
        }
    };
    let error = train(folder.path(), &config, &mut world, &Interrupt::default()).unwrap_err();
    let text = error.to_string();
    let TrainError::Step(StepError::NonFinite { step, rate, clip_ids, .. }) = &error else {
        panic!("{error}")
    };
    assert_eq!((*step, clip_ids.len(), clip_ids[0]), (6, 8, 800));
    assert!(*rate > 0.0);
    for part in ["step 6", "gradient norm", "rate", "inverse-dynamics NaN", "0:800 0:801"] {
        assert!(text.contains(part), "{text:?} does not say {part:?}");
    }
    // The last good checkpoint is there and the run can go on from it.
    finish(folder.path(), &config, &mut World::new(&hello(&config)));
}

#[test]
fn slots_of_another_run_are_refused() {
    let config = config("");
    let mut world = World::new(&hello(&config));
    world.shift = 1;
    let field = match error(&config, &mut world) {
        TrainError::Source(SourceError::Foreign { field, .. }) => field,
        other => panic!("{other}"),
    };
    assert_eq!(field, "position");

    let expected = Expected::of(&hello(&config)).unwrap();
    let mut other = hello(&config);
    other.seed += 1;
    let slot = World::new(&other).slot(0);
    assert!(matches!(expected.view(0, &slot), Err(SourceError::Foreign { field: "stream hash", .. })));
    assert!(matches!(expected.view(0, &slot[..100]), Err(SourceError::Batch { .. })));
}

fn check_misfit(change: impl FnOnce(&mut Hello), expected: &str) {
    let config = config("");
    let mut hello = hello(&config);
    change(&mut hello);
    match error(&config, &mut World::new(&hello)) {
        TrainError::Mismatch { what, .. } => assert_eq!(what, expected),
        other => panic!("expected a mismatch of {expected}, got {other}"),
    }
}

#[test]
fn data_that_does_not_fit_the_configuration_is_refused() {
    check_misfit(|hello| hello.shape.frames = 6, "frames of a clip");
    check_misfit(|hello| hello.shape.state_width = 0, "term state-alignment");
    check_misfit(|hello| hello.sequence.total_steps = 13, "train.steps of the loaders");
    check_misfit(|hello| hello.sequence.validation_batches = 3, "train.validation_batches of the loaders");
}

#[test]
fn run_folders_are_not_written_over_and_not_shared() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path().join("run");
    let (config, other) = (config(""), {
        let mut other = config("");
        other.train.rate = 0.5;
        other
    });
    assert!(matches!(RunFolder::resume(&run, &config), Err(RunFolderError::NoRun { .. })));
    let first = RunFolder::create(&run, &config).unwrap();
    assert!(matches!(RunFolder::resume(&run, &config), Err(RunFolderError::InUse { .. })));
    assert!(matches!(RunFolder::create(&run, &config), Err(RunFolderError::InUse { .. })));
    drop(first);
    // A start that never saw data leaves nothing worth keeping: the next one needs no other folder.
    RunFolder::create(&run, &other).unwrap();
    let started = RunFolder::create(&run, &config).unwrap();
    std::fs::write(started.metrics(), "").unwrap();
    drop(started);
    assert!(matches!(RunFolder::create(&run, &config), Err(RunFolderError::Exists { .. })));
    match RunFolder::resume(&run, &other) {
        Err(RunFolderError::ConfigDiffers { field, expected, got, .. }) => {
            assert_eq!((field.as_str(), expected.as_str(), got.as_str()), ("train.rate", "0.002", "0.5"));
        }
        other => panic!("{other:?}"),
    }
    let mut free = config.clone();
    free.train.log_every = 77;
    RunFolder::resume(&run, &free).unwrap();
}

#[test]
fn other_data_and_damaged_checkpoints_do_not_resume() {
    let folder = tempfile::tempdir().unwrap();
    let config = config("");
    finish(folder.path(), &config, &mut World::new(&hello(&config)));
    let mut other = hello(&config);
    other.seed += 1;
    let refused = train(folder.path(), &config, &mut World::new(&other), &Interrupt::default()).unwrap_err();
    assert!(matches!(refused, TrainError::Resume(ResumeError::OtherData { .. })), "{refused}");

    let last = folder.path().join("checkpoints/last.safetensors");
    let bytes = std::fs::read(&last).unwrap();
    std::fs::write(&last, &bytes[..bytes.len() / 2]).unwrap();
    let world = &mut World::new(&hello(&config));
    let refused = train(folder.path(), &config, world, &Interrupt::default()).unwrap_err();
    assert!(matches!(refused, TrainError::Resume(ResumeError::Checkpoint(_))), "{refused}");
    // The best checkpoint was written by the same code, but a run without moments is none to go on with.
    gawm_model::checkpoint::save(&last, &model(), &Default::default(), None).unwrap();
    let refused = train(folder.path(), &config, world, &Interrupt::default()).unwrap_err();
    assert!(matches!(refused, TrainError::Resume(ResumeError::State { .. })), "{refused}");
}

fn model() -> gawm_model::WorldModel {
    let widths = gawm_model::DataWidths { action: 2, state: 2 };
    let architecture = gawm_model::ModelConfig::preset("micro").unwrap().resolve(widths).unwrap();
    gawm_model::WorldModel::new(architecture, 1, &Device::Cpu).unwrap()
}

#[test]
fn unknown_state_dims_are_refused_by_name() {
    let config = config("velocity = [\"z\"]");
    let error = error(&config, &mut World::new(&hello(&config))).to_string();
    assert!(error.contains("velocity") && error.contains("\"z\"") && error.contains("\"x\""), "{error}");
}

/// Uploads the first batch of a world of the given views and channels.
fn upload(views: usize, channels: usize) -> (Clips, Vec<u8>, [usize; 4]) {
    let config = config("");
    let mut hello = hello(&config);
    let shape = &mut hello.shape;
    (shape.views, shape.channels, shape.height, shape.width) = (views, channels, 4, 5);
    let dims = [views, shape.height, shape.width, channels];
    let layout = BatchLayout::try_new(*shape).unwrap();
    hello.layout_hash = layout.hash();
    let mut world = World::new(&hello);
    world.draw = |shape, _, sections| {
        for (index, byte) in sections.frames.iter_mut().enumerate() {
            *byte = (index * 37 + index / shape.width) as u8;
        }
        sections.state_mask.fill(1);
        sections.state_mask[1] = 0;
        sections.action_mask.fill(1);
        sections.action_mask[2] = 0;
        sections.actions.fill(0.5);
    };
    let slot = world.slot(0);
    let view = Expected::of(&hello).unwrap();
    let view = view.view(0, &slot).unwrap();
    let uploader = Uploader::new(&Device::Cpu, &hello, None, &["y".to_owned()]).unwrap();
    (uploader.upload(&view).unwrap().clips, view.frames().to_vec(), dims)
}

#[test]
fn one_pass_over_the_bytes_gives_the_models_own_standardisation() {
    for (views, channels) in [(1, 3), (2, 3), (3, 1)] {
        let (clips, bytes, [v, h, w, c]) = upload(views, channels);
        let frames = Tensor::from_vec(bytes, (8 * 4, v, h, w, c), &Device::Cpu).unwrap();
        let frames = frames.transpose(1, 2).unwrap().reshape((8, 4, h, v * w, c)).unwrap();
        let frames = frames.broadcast_as((8, 4, h, v * w, 3)).unwrap().contiguous().unwrap();
        let expected = standardize_frames(&frames).unwrap();
        assert_eq!(clips.frames.dims(), expected.dims());
        let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(&clips.frames), values(&expected), "{views} views, {channels} channels");
    }
}

#[test]
fn masks_and_rules_reach_the_objectives() {
    let (clips, ..) = upload(1, 3);
    let mask = clips.state_mask.flatten_all().unwrap().to_vec1::<u8>().unwrap();
    // x and y of the first frames: y is a velocity, and y of the first frame is missing anyway.
    assert_eq!(mask[..4], [1, 0, 1, 1]);
    assert_eq!(mask[8..12], [1, 0, 1, 1]);
    let actions = clips.actions.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert_eq!(actions[..8], [0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.5, 0.5]);
}
