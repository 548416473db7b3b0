//! The state targets of the task schemas equal an independent computation from the recorded columns.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::io::Write as _;
use std::path::{Path, PathBuf};

use arrow::array::{Array, AsArray};
use arrow::datatypes::{DataType, Float32Type, Float64Type};
use gawm_ingest::contract::{TargetName, TaskSchema};
use gawm_ingest::tabular::{Limits, Table, open};
use support::{Dataset, run, shared};

/// Rows of a list column as numbers.
fn rows(dataset: &Dataset, column: &str) -> Vec<Vec<f64>> {
    let mut out = Vec::new();
    for batch in &dataset.batches {
        let column = &batch[column];
        for row in 0..batch.num_rows() {
            let items = match column.data_type() {
                DataType::List(_) => column.as_list::<i32>().value(row),
                _ => column.as_fixed_size_list().value(row),
            };
            out.push(match items.data_type() {
                DataType::Float32 => {
                    items.as_primitive::<Float32Type>().values().iter().map(|v| f64::from(*v)).collect()
                }
                _ => items.as_primitive::<Float64Type>().values().to_vec(),
            });
        }
    }
    out
}

/// Columns of a recording, row by row.
struct Recorded(Table);

impl Recorded {
    fn column(&self, name: &str) -> Vec<Vec<f64>> {
        let rows = self.0.read_all(name).unwrap();
        let width = rows.width();
        rows.values.to_f64().unwrap().chunks(width).map(<[f64]>::to_vec).collect()
    }
}

/// First two columns of the rotation matrix of a (w, x, y, z) quaternion, column after column.
fn rotation_6d(q: &[f64]) -> [f64; 6] {
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    let [w, x, y, z] = [q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm];
    [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y + w * z),
        2.0 * (x * z - w * y),
        2.0 * (x * y - w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z + w * x),
    ]
}

fn sin_cos(angles: &[f64]) -> Vec<f64> {
    angles.iter().flat_map(|angle| [angle.sin(), angle.cos()]).collect()
}

/// The published targets, as the method describes them.
fn reference(task: &str, recorded: &Recorded) -> Vec<Vec<f64>> {
    let of = |name: &str| recorded.column(name);
    match task {
        "tworoom" => of("proprio"),
        "reacher" => {
            of("observation").iter().map(|o| [sin_cos(&o[..2]), o[2..6].to_vec()].concat()).collect()
        }
        "pusht" => of("state").iter().map(|s| [s[..4].to_vec(), sin_cos(&s[4..5])].concat()).collect(),
        "cube" => of("observation")
            .iter()
            .zip(of("qvel"))
            .map(|(o, qvel)| {
                [
                    &o[..6],
                    &o[12..15],
                    &o[17..18],
                    &o[19..22],
                    &[o[15], o[16]],
                    &rotation_6d(&o[22..26]),
                    &o[6..12],
                    &qvel[14..20],
                ]
                .concat()
            })
            .collect(),
        _ => unreachable!("{task}"),
    }
}

fn repaired(task: &str, recorded: &Recorded) -> Vec<Vec<f64>> {
    let of = |name: &str| recorded.column(name);
    let joined = |columns: Vec<Vec<Vec<f64>>>| -> Vec<Vec<f64>> {
        (0..columns[0].len()).map(|row| columns.iter().flat_map(|c| c[row].clone()).collect()).collect()
    };
    let each = |name: &str, encode: &dyn Fn(&[f64]) -> Vec<f64>| -> Vec<Vec<f64>> {
        of(name).iter().map(|row| encode(row)).collect()
    };
    match task {
        "tworoom" => of("proprio"),
        "reacher" => joined(vec![each("qpos", &sin_cos), of("finger_pos"), of("qvel")]),
        "pusht" => joined(vec![reference("pusht", recorded), each("state", &|state| state[5..7].to_vec())]),
        "cube" => joined(vec![
            each("proprio_joint_pos", &sin_cos),
            of("proprio_effector_pos"),
            of("proprio_gripper_opening"),
            of("privileged_block_0_pos"),
            each("proprio_effector_yaw", &sin_cos),
            each("privileged_block_0_quat", &|q| rotation_6d(q).to_vec()),
            of("proprio_joint_vel"),
            each("qvel", &|qvel| qvel[14..20].to_vec()),
        ]),
        _ => unreachable!("{task}"),
    }
}

fn pipeline(task: &str) -> PathBuf {
    let name = if task == "tworoom" { "tworoom-h5" } else { task };
    support::root().join(format!("pipelines/{name}-ingest.toml"))
}

/// Ingests with a target and compares the continuous state with what is expected.
fn check_target(
    task: &str,
    target: TargetName,
    file: &Path,
    expected: &[Vec<f64>],
) -> (Dataset, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let name = if target == TargetName::Reference { "reference" } else { "repaired" };
    let set = format!("task_schema.target={name}");
    run(&pipeline(task), &out, &[file], &["--set", &set], 0);
    let dataset = Dataset::open(&out);
    let schema = TaskSchema::built_in(task).unwrap();
    let width = schema.target(target).width;
    let got = rows(&dataset, "gawm.state");
    assert_eq!(got.len(), expected.len(), "{task} {name}");
    for (row, (got, expected)) in got.iter().zip(expected).enumerate() {
        assert_eq!((got.len(), expected.len()), (width, width), "{task} {name}");
        for (column, (got, expected)) in got.iter().zip(expected).enumerate() {
            // Single precision, as the column has it.
            let distance = (got - expected).abs();
            assert!(
                distance <= 1e-6 * (1.0 + expected.abs()),
                "{task} {name}, row {row}, column {column}: expected {expected}, got {got}"
            );
        }
    }
    assert_eq!(dataset.meta["schema"]["rate_hz"], f64::from(schema.fps), "{task}");
    (dataset, folder)
}

#[test]
fn targets_of_published_recordings_are_the_computed_ones() {
    let Some(corpora) = shared() else { return };
    for task in ["tworoom", "reacher", "pusht", "cube"] {
        let file = corpora.join(format!("swm_h5/{task}.h5"));
        let recorded = Recorded(open(&file, &Limits::default()).unwrap());
        check_target(task, TargetName::Reference, &file, &reference(task, &recorded));
        let (dataset, _kept) = check_target(task, TargetName::Repaired, &file, &repaired(task, &recorded));
        assert!(
            dataset.images("observation.images.camera").iter().all(|image| image.starts_with(b"\x89PNG"))
        );
        if task == "cube" {
            let (dataset, _kept) =
                check_target(task, TargetName::Reference, &file, &reference(task, &recorded));
            check_standardisation(&dataset);
        }
    }
}

/// Sines, cosines, directions and rotations are left as they are; everything else is standardised.
fn check_standardisation(dataset: &Dataset) {
    let columns = dataset.meta["standardisation"].as_array().unwrap();
    let state = columns.iter().find(|column| column["column"] == "gawm.state").unwrap();
    let raw: Vec<usize> = state["dims"]
        .as_array()
        .unwrap()
        .iter()
        .enumerate()
        .filter(|(_, dim)| dim["is_standardised"] == false)
        .map(|(index, _)| index)
        .collect();
    assert_eq!(raw, (13..21).collect::<Vec<_>>());
}

/// Writes arrays of numbers as an .npz file.
fn write_npz(path: &Path, arrays: &[(&str, &[usize], Vec<f32>)], images: (&str, &[usize], &[u8])) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let mut write = |name: &str, dtype: &str, shape: &[usize], bytes: &[u8]| {
        let extent: Vec<String> = shape.iter().map(|n| format!("{n},")).collect();
        let header =
            format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({}), }}", extent.concat());
        let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
        zip.start_file(format!("{name}.npy"), options).unwrap();
        zip.write_all(b"\x93NUMPY\x01\x00").unwrap();
        zip.write_all(&(padded as u16).to_le_bytes()).unwrap();
        zip.write_all(format!("{header:<width$}\n", width = padded - 1).as_bytes()).unwrap();
        zip.write_all(bytes).unwrap();
    };
    for (name, shape, values) in arrays {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        write(name, "<f4", shape, &bytes);
    }
    write(images.0, "|u1", images.1, images.2);
    zip.finish().unwrap();
}

#[test]
fn the_ping_pong_schema_takes_its_columns_in_order() {
    const ROWS: usize = 12;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("pingpong.npz");
    let columns = [
        ("proprio_effector_pos", 3),
        ("proprio_effector_vel", 3),
        ("proprio_gripper_opening", 1),
        ("privileged_target_box_pos", 3),
        ("privileged_ball_pos", 3),
        ("privileged_ball_vel", 3),
    ];
    let value = |column: usize, row: usize, at: usize| (column * 100 + row * 10 + at) as f32 * 0.125;
    let mut expected = vec![Vec::new(); ROWS];
    let mut arrays = Vec::new();
    let mut shapes = Vec::new();
    for (column, (_, width)) in columns.iter().enumerate() {
        shapes.push([ROWS, *width]);
        let mut values = Vec::new();
        for (row, expected) in expected.iter_mut().enumerate() {
            for at in 0..*width {
                values.push(value(column, row, at));
                expected.push(f64::from(value(column, row, at)));
            }
        }
        arrays.push(values);
    }
    let mut named: Vec<(&str, &[usize], Vec<f32>)> = columns
        .iter()
        .zip(&shapes)
        .zip(arrays)
        .map(|(((name, _), shape), values)| (*name, shape.as_slice(), values))
        .collect();
    let action: Vec<f32> = (0..ROWS * 5).map(|i| i as f32 * 0.01).collect();
    named.push(("action", &[ROWS, 5], action));
    write_npz(&file, &named, ("pixels", &[ROWS, 8, 8, 3], &[7; ROWS * 8 * 8 * 3]));
    for target in [TargetName::Reference, TargetName::Repaired] {
        check_target("pingpong", target, &file, &expected);
    }
    let schema = TaskSchema::built_in("pingpong").unwrap();
    assert_eq!(schema.reference.supervised.as_deref(), Some(&[3, 4, 5, 13, 14, 15][..]));
    assert_eq!(schema.repaired.supervised, None);
}

#[test]
fn unknown_schemas_are_named() {
    let error = TaskSchema::built_in("acrobot").unwrap_err().to_string();
    assert!(error.contains("cube, pingpong, pusht, reacher, tworoom"), "{error}");
    for task in ["cube", "pingpong", "pusht", "reacher", "tworoom"] {
        let schema = TaskSchema::built_in(task).unwrap();
        assert_eq!(schema, TaskSchema::load(&support::root().join(format!("schemas/{task}.toml"))).unwrap());
    }
}
