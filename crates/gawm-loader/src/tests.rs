#[path = "../tests/fixture/mod.rs"]
mod fixture;

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use gawm_dataset::GawmMeta;
use gawm_image::decode_rgb_into;
use gawm_schema::batch::{BatchView, Hello, Section, Split};

use self::fixture::{EpisodePlan, SIZE, episode, plans, raw, wrist_jpeg, write};
use crate::{BatchMaker, Cache, CachePlan, Compat, Index, LoadError, LoaderConfig, MixEntry, RunLength};

static GO_ON: AtomicBool = AtomicBool::new(false);

fn config() -> LoaderConfig {
    LoaderConfig { batch: 4, ..LoaderConfig::default() }
}

fn run() -> RunLength {
    RunLength { total_steps: 40, validate_every: 15, validation_batches: 3, ..RunLength::default() }
}

/// A dataset in a folder that lives as long as the test.
fn dataset(plans: &[EpisodePlan]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("data");
    write(&path, plans);
    (folder, path)
}

fn index(path: &Path, config: &LoaderConfig) -> Index {
    Index::build(&[path.to_owned()], config, run()).unwrap()
}

fn refusal(path: &Path, config: &LoaderConfig) -> LoadError {
    Index::build(&[path.to_owned()], config, run()).unwrap_err()
}

/// Makes batch n in aligned memory and calls `look` with its view.
fn with_batch<R>(index: &Index, cache: Option<Cache>, n: u64, look: impl FnOnce(&BatchView<'_>) -> R) -> R {
    let maker = BatchMaker::new(index, cache, 0, 1).unwrap();
    let layout = index.layout();
    let mut memory = vec![0xee; layout.total_bytes() + 64];
    let start = memory.as_ptr().align_offset(64);
    let slot = &mut memory[start..start + layout.total_bytes()];
    maker.fill(n, slot, &GO_ON).unwrap().write(layout, slot);
    look(&BatchView::try_new(layout, slot).unwrap())
}

/// Returns the bytes of all sections of a batch.
fn content(index: &Index, cache: Option<Cache>, n: u64) -> Vec<u8> {
    with_batch(index, cache, n, |view| {
        let mut bytes = view.frames().to_vec();
        bytes.extend(view.clip_ids().iter().flat_map(|id| id.to_le_bytes()));
        bytes.extend(view.actions().iter().chain(view.states()).flat_map(|v| v.to_le_bytes()));
        bytes.extend([view.action_mask(), view.state_mask(), view.frame_mask()].concat());
        bytes
    })
}

/// The episode and row within it of a row of the dataset.
fn place_of(plans: &[EpisodePlan], mut row: u64) -> (usize, usize) {
    for (number, plan) in plans.iter().enumerate() {
        if row < plan.rows as u64 {
            return (number, row as usize);
        }
        row -= plan.rows as u64;
    }
    panic!("no such row");
}

fn standardisation(path: &Path, column: &str) -> Vec<(f64, f64)> {
    let meta: GawmMeta =
        serde_json::from_slice(&std::fs::read(path.join("meta/gawm.json")).unwrap()).unwrap();
    let of_column = meta.standardisation.iter().find(|s| s.column == column).unwrap();
    of_column.dims.iter().map(|d| (d.mean, d.scale)).collect()
}

/// Compares every number and pixel of a clip with what was written, by the rules written down in the format and nothing of
/// the loader.
fn check_clip(path: &Path, plans: &[EpisodePlan], view: &BatchView<'_>, clip: usize, is_training: bool) {
    let row = view.clip_ids()[clip];
    let (number, start) = place_of(plans, row);
    let plan = &plans[number];
    assert_eq!(plan.is_training, is_training, "episode {number}");
    assert!(start + 16 <= plan.rows, "clip {row} leaves its episode");
    let (state_fit, action_fit) = (standardisation(path, "gawm.state"), standardisation(path, "gawm.action"));
    let standard = |value: f64, (mean, scale): (f64, f64)| ((f64::from(value as f32) - mean) / scale) as f32;
    let pixels = (SIZE[0] * SIZE[1] * 3) as usize;
    for t in 0..4 {
        let at = clip * 4 + t;
        let (this, local) = (row + 5 * t as u64, start + 5 * t);
        let frame = |camera: usize| &view.frames()[(at * 2 + camera) * pixels..][..pixels];
        let front: Vec<u8> = (0..SIZE[0])
            .flat_map(|y| (0..SIZE[1]).flat_map(move |x| fixture::front_pixel(this, y, x)))
            .collect();
        assert_eq!(frame(0), front, "front frame {t} of clip {row}");
        let mut wrist = vec![0; pixels];
        decode_rgb_into(&wrist_jpeg(this), SIZE[1], SIZE[0], &mut wrist).unwrap();
        assert_eq!(frame(1), wrist, "wrist frame {t} of clip {row}");
        assert_eq!(view.frame_mask()[at * 2..][..2], [1, 1]);
        let (state, _) = raw(this);
        let encoded =
            [state[0], f64::from(state[1] as f32).sin(), f64::from(state[1] as f32).cos(), state[2]];
        let is_gripper_valid = !plan.bad_grippers.contains(&local);
        for (dim, value) in encoded.into_iter().enumerate() {
            let is_valid = dim < 3 || is_gripper_valid;
            let expected = if is_valid { standard(value, state_fit[dim]) } else { 0.0 };
            let got = view.states()[at * 4 + dim];
            assert!((got - expected).abs() < 1e-6, "state {dim} at {this}: expected {expected}, got {got}");
            assert_eq!(view.state_mask()[at * 4 + dim], u8::from(is_valid));
        }
        let chunk = &view.actions()[at * 10..][..10];
        assert_eq!(view.action_mask()[at], u8::from(t < 3));
        for (i, got) in chunk.iter().enumerate() {
            let expected = match t {
                3 => 0.0,
                _ => standard(raw(this + i as u64 / 2).1[i % 2], action_fit[i % 2]),
            };
            assert!((got - expected).abs() < 1e-6, "action {i} of chunk {t}: expected {expected}, got {got}");
        }
    }
}

#[test]
fn every_clip_is_what_was_written() {
    let (_folder, path) = dataset(&plans());
    let index = index(&path, &config());
    let sequence = index.hello().sequence;
    let mut clips = [0, 0];
    for n in 0..sequence.batches() {
        let batch = sequence.batch(n).unwrap();
        with_batch(&index, None, n, |view| {
            let is_training = batch.split == Split::Train;
            clips[usize::from(is_training)] += view.shape().clips;
            (0..view.shape().clips).for_each(|clip| check_clip(&path, &plans(), view, clip, is_training));
        });
    }
    // Three validations of 9 + 15 clips in batches of 4, of which 3 are taken; 40 training steps.
    assert_eq!(clips, [3 * 12, 40 * 4]);
}

#[test]
fn clips_that_touch_a_hole_are_left_out_and_counted() {
    let (_folder, path) = dataset(&plans());
    let hello = index(&path, &config()).hello().clone();
    // By hand. Episode of 40 rows: 25 starts. Of 33 rows: 18, without those with a frame at row 12 (2, 7, 12): 15.
    // Of 16 rows: 1. Of 15 rows: none. Of 45 rows: 30, without those with an action in row 20 (starts 6 to 20): 15.
    let (train, validation) = (hello.train, hello.validation);
    assert_eq!((train.episodes, train.clips, train.excluded, train.short_episodes), (5, 56, 18, 1));
    assert_eq!(
        (validation.episodes, validation.clips, validation.excluded, validation.short_episodes),
        (3, 24, 0, 1)
    );
    assert_eq!(hello.sequence.steps_per_epoch, 14);
    assert_eq!((hello.shape.action_width, hello.shape.state_width, hello.span), (10, 4, 16));
    assert_eq!(hello.cameras, ["observation.images.front", "observation.images.wrist"]);
    let names: Vec<_> = hello.state.dims.iter().map(|d| d.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "observation.state:x",
            "observation.state:yaw.sin",
            "observation.state:yaw.cos",
            "observation.gripper:opening"
        ]
    );
    // Standardised values of the training rows have variance 1; sines and cosines keep theirs. The dataset fits all dims of
    // the state on rows where all of it is valid, which leaves out one row where only the gripper is not.
    let variance = &hello.baselines.state_variance;
    assert!((variance[0] - 1.0).abs() < 0.02 && (variance[3] - 1.0).abs() < 1e-6, "{variance:?}");
    assert!(variance[1] < 0.9, "{variance:?}");
    assert!((hello.baselines.action_variance[0] - 1.0).abs() < 1e-6);
}

#[test]
fn an_epoch_has_every_clip_once_and_validation_is_always_the_same() {
    let (_folder, path) = dataset(&plans());
    let index = index(&path, &config());
    let sequence = index.hello().sequence;
    let mut epochs = vec![Vec::new(); 3];
    let mut validations = vec![Vec::new(); 3];
    for n in 0..sequence.batches() {
        let batch = sequence.batch(n).unwrap();
        match batch.split {
            Split::Train => epochs[batch.epoch as usize].extend(index.clips_of(batch)),
            Split::Validation => validations[batch.epoch as usize].extend(index.clips_of(batch)),
        }
    }
    assert_ne!(epochs[0], epochs[1]);
    epochs.iter_mut().for_each(|epoch| epoch.sort_unstable());
    assert_eq!(epochs[0], epochs[1]);
    assert_eq!(epochs[0].len(), 56);
    epochs[0].dedup();
    assert_eq!(epochs[0].len(), 56);
    assert_eq!(validations[0], validations[1]);
    assert_eq!(validations[0], validations[2]);
}

#[test]
fn a_batch_depends_on_its_position_alone() {
    let (_folder, path) = dataset(&plans());
    let first = index(&path, &config());
    // Backwards, with other threads, from an index built anew.
    let second = index(&path, &LoaderConfig { threads: 3, ..config() });
    assert_eq!(first.stream_hash(), second.stream_hash());
    for n in (0..first.hello().sequence.batches()).rev().step_by(7) {
        assert!(content(&second, None, n) == content(&first, None, n), "batch {n}");
    }
    let other = index(&path, &LoaderConfig { seed: 1, ..config() });
    assert_ne!(other.stream_hash(), first.stream_hash());
    assert!(content(&other, None, 0) != content(&first, None, 0));
}

#[test]
fn ranks_share_a_step() {
    let (_folder, path) = dataset(&plans());
    let alone =
        Index::build(std::slice::from_ref(&path), &LoaderConfig { batch: 8, ..config() }, run()).unwrap();
    let of_rank = |rank| {
        Index::build(std::slice::from_ref(&path), &config(), RunLength { rank, ranks: 2, ..run() }).unwrap()
    };
    let ranks = [of_rank(0), of_rank(1)];
    assert_eq!(ranks[0].stream_hash(), ranks[1].stream_hash());
    for n in 0..7 {
        let batch = alone.hello().sequence.batch(n).unwrap();
        let parts = ranks.each_ref().map(|index| index.clips_of(batch));
        assert_eq!(parts.concat(), alone.clips_of(batch));
    }
}

#[test]
fn the_reference_is_as_published() {
    let (_folder, path) = dataset(&plans());
    let config = LoaderConfig { compat: Compat::Reference, ..config() };
    let index = index(&path, &config);
    let hello = index.hello();
    // len - 19 clips of each episode of 20 rows or more; holes do not matter; 9 to 1 by clip.
    let starts: Vec<u64> = [(0, 40), (40, 33), (104, 24), (128, 45), (180, 30)]
        .into_iter()
        .flat_map(|(first, rows)| first..first + rows - 19)
        .collect();
    assert_eq!(starts.len(), 77);
    let order = crate::Mt19937::new(3072).permutation(77);
    let n_train = 77 - 7;
    assert_eq!((hello.train.clips, hello.validation.clips), (n_train, 7));
    assert_eq!((hello.span, hello.train.short_episodes), (20, 3));
    // The sampler's generator is a second one of the same seed.
    let mut sampler = crate::Mt19937::new(3072);
    sampler.next_i64();
    let epoch = sampler.permutation(n_train as u32);
    let expected: Vec<u64> = epoch[..4].iter().map(|i| starts[order[*i as usize] as usize]).collect();
    assert_eq!(index.clips_of(hello.sequence.batch(0).unwrap()), expected);
    let held: Vec<u64> = order[n_train as usize..].iter().map(|i| starts[*i as usize]).collect();
    let validation: Vec<u64> =
        (15..17).flat_map(|n| index.clips_of(hello.sequence.batch(n).unwrap())).collect();
    assert_eq!(validation, held);
    // Mean and std with ddof 1 over all rows, without those that have no action.
    let plans = plans();
    let valid = |row: &u64| {
        let (number, local) = place_of(&plans, *row);
        local + 1 < plans[number].rows && !plans[number].bad_actions.contains(&local)
    };
    let values: Vec<f64> = (0..210).filter(valid).map(|row| f64::from(raw(row).1[0] as f32)).collect();
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt();
    let dim = &hello.action.dims[0];
    assert!((dim.mean - mean).abs() < 1e-9 && (dim.scale - std).abs() < 1e-9, "{dim:?} {mean} {std}");
    // The fourth chunk is there, and an action that is missing is 0, the mean.
    with_batch(&index, None, 0, |view| {
        let (row, clip) = (view.clip_ids()[1], 1);
        for (i, got) in view.actions()[(clip * 4 + 3) * 10..][..10].iter().enumerate() {
            let source = row + 15 + i as u64 / 2;
            let dim = &hello.action.dims[i % 2];
            let raw = f64::from(raw(source).1[i % 2] as f32);
            let expected = if valid(&source) { ((raw - dim.mean) / dim.scale) as f32 } else { 0.0 };
            assert!((got - expected).abs() < 1e-6, "{i}: expected {expected}, got {got}");
        }
    });
}

#[test]
fn frames_are_resized_as_pillow_does() {
    let (_folder, path) = dataset(&plans());
    let cameras = vec!["observation.images.front".to_owned()];
    let config = LoaderConfig { image_size: Some([7, 9]), cameras, ..config() };
    let index = index(&path, &config);
    with_batch(&index, None, 0, |view| {
        assert_eq!((view.shape().views, view.shape().height, view.shape().width), (1, 7, 9));
        let row = view.clip_ids()[0];
        let pixels =
            (0..SIZE[0]).flat_map(|y| (0..SIZE[1]).flat_map(move |x| fixture::front_pixel(row, y, x)));
        let image =
            gawm_image::Image::try_new(SIZE[1], SIZE[0], gawm_image::Pixels::Rgb8(pixels.collect())).unwrap();
        let resized = gawm_image::resize(&image, 9, 7).unwrap();
        let gawm_image::Pixels::Rgb8(expected) = resized.pixels() else { panic!("colour stays colour") };
        assert_eq!(view.frames()[..7 * 9 * 3], *expected);
    });
}

#[test]
fn state_features_can_be_chosen() {
    let (_folder, path) = dataset(&plans());
    let chosen = LoaderConfig { state_features: vec!["observation.gripper".to_owned()], ..config() };
    let (all, index) = (index(&path, &config()), index(&path, &chosen));
    assert_eq!(index.hello().shape.state_width, 1);
    let gripper: Vec<f32> =
        with_batch(&all, None, 0, |v| v.states().iter().skip(3).step_by(4).copied().collect());
    with_batch(&index, None, 0, |view| assert_eq!(view.states(), gripper));
    let wrong = LoaderConfig { state_features: vec!["action".to_owned()], ..config() };
    assert!(matches!(refusal(&path, &wrong), LoadError::Dataset { .. }));
}

#[test]
fn the_cache_gives_the_same_batches() {
    let (_folder, path) = dataset(&plans());
    let index = index(&path, &LoaderConfig { cache: true, ..config() });
    let plan = CachePlan::of(&index);
    assert_eq!((plan.frames, plan.bytes, plan.exists), (420, 4096 + 420 * 576, false));
    assert!(matches!(plan.check_budget(0.0001), Err(LoadError::CacheBudget { .. })));
    plan.check_budget(1.0).unwrap();
    let open = || CachePlan::of(&index).open_or_make(&index, &GO_ON, &|_| {});
    // What a killed writer left is no cache.
    std::fs::create_dir_all(plan.path.parent().unwrap()).unwrap();
    std::fs::write(plan.path.with_extension("tmp"), vec![1; 1 << 20]).unwrap();
    assert!(open().unwrap().is_intact());
    for n in 0..index.hello().sequence.batches() {
        assert!(content(&index, Some(open().unwrap()), n) == content(&index, None, n), "batch {n}");
    }
    let whole = std::fs::read(&plan.path).unwrap();
    let spoil = |at: usize, length: usize| {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        bytes.truncate(length);
        let unfinished = plan.path.with_extension("spoilt");
        std::fs::write(&unfinished, bytes).unwrap();
        std::fs::rename(&unfinished, &plan.path).unwrap();
        open()
    };
    assert!(!spoil(5000, whole.len()).unwrap().is_intact());
    for (at, length) in [
        (0, whole.len()),
        (8, whole.len()),
        (20, whole.len()),
        (49, whole.len()),
        (100, whole.len()),
        (5000, 5000),
    ] {
        assert!(matches!(spoil(at, length), Err(LoadError::Cache { .. })), "byte {at}, {length} bytes");
    }
}

#[test]
fn datasets_are_mixed_by_weight() {
    let (_first, one) = dataset(&[episode(35, true), episode(20, false)]);
    let (_second, two) = dataset(&[episode(55, true), episode(30, false)]);
    let mix = vec![MixEntry { data: two.clone(), weight: 1.5 }];
    let config = LoaderConfig { mix, weight: 1.0, ..config() };
    let index = index(&one, &config);
    let hello = index.hello();
    // 20 and 40 clips; shares 20 : 60 of 60 clips per epoch.
    assert_eq!((hello.train.clips, hello.sequence.steps_per_epoch), (60, 15));
    assert_eq!(hello.datasets.iter().map(|d| d.share).collect::<Vec<_>>(), [0.25, 0.75]);
    let mut drawn = [0, 0];
    for step in 0..15 {
        for id in index.clips_of(gawm_schema::batch::BatchId { split: Split::Train, epoch: 0, step }) {
            drawn[(id >> 48) as usize] += 1;
        }
    }
    assert_eq!(drawn, [15, 45]);
    // Means are pooled by rows: 34 and 54 valid actions.
    let means = [&one, &two].map(|path| standardisation(path, "gawm.action")[0].0);
    let pooled = (34.0 * means[0] + 54.0 * means[1]) / 88.0;
    assert!((hello.action.dims[0].mean - pooled).abs() < 1e-9);
    with_batch(&index, None, 0, |view| {
        let (id, got) = (view.clip_ids()[0], view.actions()[0]);
        let dim = &hello.action.dims[0];
        let expected = ((f64::from(raw(id & 0xffff_ffff).1[0] as f32) - dim.mean) / dim.scale) as f32;
        assert!((got - expected).abs() < 1e-6);
    });
    let cameras = vec!["observation.images.front".to_owned()];
    let narrowed = LoaderConfig { cameras, ..config };
    assert!(Index::build(&[one], &narrowed, run()).is_ok());
}

#[test]
fn unusable_datasets_are_refused() {
    let (_folder, path) = dataset(&plans());
    let with = |change: &dyn Fn(&mut LoaderConfig)| {
        let mut config = config();
        change(&mut config);
        refusal(&path, &config)
    };
    assert!(matches!(
        with(&|c| c.batch = 57),
        LoadError::TooFewClips { expected: 57, got: 56, excluded: 18, short: 1 }
    ));
    assert!(matches!(with(&|c| c.cameras = vec!["rear".to_owned()]), LoadError::Dataset { .. }));
    assert!(matches!(with(&|c| c.weight = 0.0), LoadError::TooFewClips { got: 0, .. }));
    assert!(matches!(refusal(Path::new("no such folder"), &config()), LoadError::Open(_)));
    std::fs::rename(path.join("data/chunk-000/file-001.parquet"), path.join("elsewhere")).unwrap();
    assert!(matches!(with(&|_| {}), LoadError::Dataset { .. }));
    std::fs::rename(path.join("elsewhere"), path.join("data/chunk-000/file-001.parquet")).unwrap();
    std::fs::remove_file(path.join("meta/gawm.json")).unwrap();
    match with(&|_| {}) {
        LoadError::Dataset { expected, .. } => assert_eq!(expected, "meta/gawm.json"),
        other => panic!("expected a refusal, got {other:?}"),
    }
}

#[test]
fn a_frame_that_cannot_be_decoded_is_named() {
    let (_folder, path) = dataset(&plans());
    let file = path.join("data/chunk-000/file-000.parquet");
    let mut bytes = std::fs::read(&file).unwrap();
    // Every JPEG of the first file loses its first marker.
    let starts: Vec<usize> =
        (0..bytes.len() - 4).filter(|i| bytes[*i..*i + 4] == [0xff, 0xd8, 0xff, 0xe0]).collect();
    assert!(starts.len() > 80, "{}", starts.len());
    starts.iter().for_each(|at| bytes[*at] = 0);
    std::fs::write(&file, bytes).unwrap();
    let index = index(&path, &config());
    let maker = BatchMaker::new(&index, None, 0, 1).unwrap();
    let mut memory = vec![0; index.layout().total_bytes() + 64];
    let start = memory.as_ptr().align_offset(64);
    let slot = &mut memory[start..start + index.layout().total_bytes()];
    let outcomes: Vec<_> = (0..14).map(|n| maker.fill(n, slot, &GO_ON)).collect();
    let error = outcomes.into_iter().find_map(Result::err).expect("a batch of the first file");
    match error {
        LoadError::Frame { camera, row, .. } => {
            assert_eq!(camera, "observation.images.wrist");
            assert!(row < 89, "{row}");
        }
        other => panic!("expected a frame, got {other:?}"),
    }
}

#[test]
fn the_hello_is_read_back() {
    let (_folder, path) = dataset(&plans());
    let hello = index(&path, &config()).hello().clone();
    assert_eq!(Hello::from_json(hello.to_json().as_bytes()), Ok(hello.clone()));
    assert_eq!(hello.layout().unwrap().offset(Section::ClipIds), 320);
}

fn check_config(text: &str, settings: &[&str], expected: Result<&dyn Fn(&LoaderConfig) -> bool, &str>) {
    let settings: Vec<String> = settings.iter().map(|s| (*s).to_owned()).collect();
    match (LoaderConfig::from_pipeline(text, &settings), expected) {
        (Ok(config), Ok(is_right)) => assert!(is_right(&config), "{config:?}"),
        (Err(error), Err(part)) => assert!(error.to_string().contains(part), "{error}"),
        (got, expected) => panic!("expected ok: {}, got {got:?}", expected.is_ok()),
    }
}

#[test]
fn configurations_are_read_or_refused() {
    check_config("", &[], Ok(&|c| *c == LoaderConfig::default()));
    check_config("[train]\nsteps = 5\n[loader]\nbatch = 8", &[], Ok(&|c| c.batch == 8));
    check_config(
        "",
        &["loader.batch=9", "loader.cameras=[\"a\"]"],
        Ok(&|c| c.batch == 9 && c.cameras == ["a"]),
    );
    check_config("", &["loader.compat=reference"], Ok(&|c| c.compat == Compat::Reference && c.span() == 20));
    check_config("[[loader.mix]]\ndata = \"x\"", &[], Ok(&|c| c.mix[0].weight == 1.0));
    check_config("[loader]\nbatsh = 8", &[], Err("batsh"));
    check_config("[lauder]", &[], Err("[lauder]"));
    check_config("[loader]\nbatch = 0", &[], Err("batch"));
    check_config("[loader]\nslots = 17", &[], Err("slots"));
    check_config("[loader]\nweight = -1.0", &[], Err("weight"));
    check_config("[loader]\ncache_budget_gib = nan", &[], Err("cache_budget_gib"));
    check_config("", &["batch=9"], Err("--set"));
    check_config("", &["loader.batch"], Err("--set"));
    check_config("", &["loader.batch="], Err("batch"));
    let printed = LoaderConfig { image_size: Some([1, 2]), ..LoaderConfig::default() };
    check_config(&printed.to_toml(), &[], Ok(&|c| *c == printed));
}
