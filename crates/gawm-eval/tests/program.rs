//! The program as users run it: files, exit codes, what errors say.
#![expect(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod support;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use support::{Training, train, write_dataset};

/// A dataset and an untrained run on it; made once, never written to.
struct World {
    root: tempfile::TempDir,
}

impl World {
    fn data(&self) -> PathBuf {
        self.root.path().join("data")
    }

    fn run(&self) -> PathBuf {
        self.root.path().join("run")
    }
}

fn world() -> &'static World {
    static WORLD: OnceLock<World> = OnceLock::new();
    WORLD.get_or_init(|| {
        let world = World { root: tempfile::tempdir().unwrap() };
        write_dataset(&world.data(), 14, 1, 16, 0.5).unwrap();
        let training = Training {
            preset: "micro".to_owned(),
            objective: "sa-idm".to_owned(),
            steps: 3,
            clips: 4,
            rate: 1e-3,
            seed: 1,
        };
        train(&world.data(), &world.run(), &training, &|_, _| ()).unwrap();
        world
    })
}

fn eval(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gawm-eval")).args(arguments).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A search that takes no time.
const QUICK: [&str; 4] = [
    "--set",
    "plan.planner={samples=8,iterations=1,elites=2,horizon=1,receding=1,kept_elites=0}",
    "--set",
    "plan.count=5",
];

#[track_caller]
fn check(output: &Output, code: i32, says: &str) {
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(code), "{stdout}\n{stderr}");
    assert!(stdout.contains(says) || stderr.contains(says), "expected {says:?} in\n{stdout}\n{stderr}");
}

#[test]
fn plan_compare_and_both_protocols() {
    let world = world();
    let out = tempfile::tempdir().unwrap();
    let (honest, reference) = (out.path().join("honest"), out.path().join("reference"));
    let run = world.run();
    let mut arguments = vec!["plan", text(&run), "--out", text(&honest)];
    arguments.extend(QUICK);
    check(&eval(&arguments), 0, "wall (5 problems");
    let data = world.data();
    let mut arguments =
        vec!["plan", text(&run), "--protocol", "reference", "--data", text(&data), "--out", text(&reference)];
    arguments.extend(QUICK);
    check(&eval(&arguments), 0, "published (5 problems");
    check(&eval(&["compare", text(&honest), text(&reference)]), 0, "| sa-idm |");
    let again = out.path().join("again");
    let mut arguments = vec!["plan", text(&run), "--threads", "1", "--out", text(&again)];
    arguments.extend(QUICK);
    check(&eval(&arguments), 0, "");
    for file in ["plan.json", "outcomes-wall.jsonl", "outcomes-non-trivial.jsonl"] {
        let read = |folder: &Path| std::fs::read_to_string(folder.join(file)).unwrap();
        assert!(read(&honest) == read(&again), "{file} depends on the number of threads");
    }
}

#[test]
fn diagnose_and_probe_write_what_they_promise() {
    let world = world();
    let out = tempfile::tempdir().unwrap();
    let folder = out.path().join("diagnose");
    let (run, data) = (world.run(), world.data());
    let quick = ["--set", "diagnose.probe={epochs=2,hidden=8}", "--set", "diagnose.trajectories=4"];
    let mut arguments = vec!["diagnose", text(&run), "--data", text(&data), "--out", text(&folder)];
    arguments.extend(quick);
    check(&eval(&arguments), 0, "4 trajectories");
    for file in ["diagnose.json", "index.html", "pca.svg", "energy.svg", "probes.csv", "trajectories.parquet"]
    {
        assert!(folder.join(file).is_file(), "{file}");
    }
    let read = |path: PathBuf| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
    };
    let first = read(folder.join("diagnose.json"));
    assert_eq!(first["is_held_out"], true);
    // The stored trajectories are taken again, whatever the seed says.
    let second_folder = out.path().join("second");
    let ids = folder.join("diagnose.json");
    let mut arguments = vec!["diagnose", text(&run), "--data", text(&data), "--out", text(&second_folder)];
    arguments.extend(["--trajectories", text(&ids), "--set", "diagnose.seed=7"]);
    arguments.extend(quick);
    check(&eval(&arguments), 0, "");
    let second = read(second_folder.join("diagnose.json"));
    assert_eq!(first["trajectory_ids"], second["trajectory_ids"]);
    assert_eq!(first["geometry"], second["geometry"]);
    let probe = out.path().join("probe");
    let mut arguments =
        vec!["probe", text(&run), "--data", text(&data), "--out", text(&probe), "--untrained", "3"];
    arguments.extend(quick);
    check(&eval(&arguments), 0, "x,linear,0,");
}

#[test]
fn exported_weights_can_be_imported() {
    let out = tempfile::tempdir().unwrap();
    let file = out.path().join("weights.safetensors");
    let run = world().run();
    check(
        &eval(&["export", text(&run), "--out", text(&file), "--layout", "transformers4"]),
        0,
        "weights.safetensors",
    );
    let device = gawm_model::Device::Cpu;
    let model = gawm_model::checkpoint::import(&file, &Default::default(), &device).unwrap();
    assert_eq!(model.architecture().widths().action, 10);
}

/// Copies the run, lets `damage` at it, and plans with it.
fn plan_with(damage: impl FnOnce(&Path)) -> Output {
    let out = tempfile::tempdir().unwrap();
    let run = out.path().join("run");
    std::fs::create_dir_all(run.join("checkpoints")).unwrap();
    for file in ["config.toml", "hello.json", "checkpoints/best.safetensors"] {
        std::fs::copy(world().run().join(file), run.join(file)).unwrap();
    }
    damage(&run);
    let mut arguments = vec!["plan", text(&run)];
    arguments.extend(QUICK);
    eval(&arguments)
}

#[test]
fn damaged_runs_are_refused_with_the_reason() {
    check(&plan_with(|run| std::fs::remove_file(run.join("hello.json")).unwrap()), 1, "hello.json");
    let no_checkpoint = plan_with(|run| std::fs::remove_dir_all(run.join("checkpoints")).unwrap());
    check(&no_checkpoint, 1, "hint: train longer");
    check(&plan_with(|run| std::fs::write(run.join("hello.json"), "{}").unwrap()), 1, "format_version");
    check(
        &plan_with(|run| std::fs::write(run.join("config.toml"), "[objectives").unwrap()),
        1,
        "config.toml",
    );
    let cut = plan_with(|run| {
        let file = run.join("checkpoints/best.safetensors");
        let bytes = std::fs::read(&file).unwrap();
        std::fs::write(&file, &bytes[..bytes.len() / 2]).unwrap();
    });
    check(&cut, 1, "damaged checkpoint");
    let other_schema = plan_with(|run| {
        let file = run.join("hello.json");
        let mut hello: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        let hash = hello["schema_hash"].as_str().unwrap();
        let other: String = hash.chars().map(|c| if c == 'a' { 'b' } else { 'a' }).collect();
        hello["schema_hash"] = other.into();
        std::fs::write(&file, hello.to_string()).unwrap();
    });
    check(&other_schema, 1, "the checkpoint is of another schema: expected");
}

#[test]
fn a_goal_image_that_is_missing_is_named() {
    use arrow::array::{Array, ArrayRef, RecordBatch, StructArray, new_null_array};
    let out = tempfile::tempdir().unwrap();
    let data = out.path().join("data");
    copy(&world().data(), &data);
    // Every frame becomes null, in every data file.
    for file in std::fs::read_dir(data.join("data/chunk-000")).unwrap() {
        let path = file.unwrap().path();
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(
            std::fs::File::open(&path).unwrap(),
        );
        let batches: Vec<RecordBatch> = reader.unwrap().build().unwrap().map(Result::unwrap).collect();
        let schema = batches[0].schema();
        let sink = std::fs::File::create(&path).unwrap();
        let mut writer = parquet::arrow::ArrowWriter::try_new(sink, schema.clone(), None).unwrap();
        for batch in batches {
            let columns =
                batch.columns().iter().map(|column| match column.as_any().downcast_ref::<StructArray>() {
                    Some(images) => new_null_array(images.data_type(), images.len()),
                    None => ArrayRef::clone(column),
                });
            writer.write(&RecordBatch::try_new(schema.clone(), columns.collect()).unwrap()).unwrap();
        }
        writer.close().unwrap();
    }
    let run = world().run();
    let target = out.path().join("plan");
    let mut arguments =
        vec!["plan", text(&run), "--protocol", "reference", "--data", text(&data), "--out", text(&target)];
    arguments.extend(QUICK);
    check(&eval(&arguments), 1, "no image of observation.images.camera in row");
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

#[test]
fn wrong_arguments_exit_with_2() {
    check(&eval(&["plan"]), 2, "--out is needed");
    check(&eval(&["fly"]), 2, "fly");
    let run = world().run();
    check(&eval(&["plan", text(&run), "--set", "plan.cuont=3"]), 2, "cuont");
    check(&eval(&["plan", text(&run), "--set", "plan.planner.samples=1"]), 2, "planner.samples: expected");
    check(&eval(&["plan", text(&run), "--set", "plan.source=dataset"]), 2, "hint: add --data DIR");
    check(&eval(&["plan", "--print-config"]), 0, "[eval.plan]");
}
