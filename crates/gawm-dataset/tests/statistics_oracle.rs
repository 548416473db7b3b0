//! Statistics against numpy: `golden/statistics.json` was computed by `xtask/interop/statistics_oracle.py`.

#![expect(clippy::unwrap_used, reason = "a test stops where its set-up fails")]

use std::collections::BTreeMap;

use gawm_dataset::read::{Dataset, ReadLimits};
use gawm_dataset::stats::{dataset_stats, lerobot_stats, to_json};
use gawm_dataset::{
    DatasetSpec, DatasetWriter, EpisodeInfo, RecordingInfo, Rows, Trajectory, VectorColumn, WriteMode,
};
use serde_json::{Value, json};

const SCHEMA: &str = r#"
rate_hz = 20.0
streams = []
[[features]]
name = "observation.state"
role = "state"
data = { type = "vector", dtype = "float64", parts = [
    { kind = "angle", wrap = "pi", dims = [{ name = "turn", unit = "rad", source = "/a:b" }] },
    { kind = "linear", dims = [{ name = "walk", unit = "m", source = "/a:c" }, { name = "held", unit = "m", source = "/a:d" }] },
] }
"#;

/// The generator of the script.
struct Uniform(u32);

impl Uniform {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(self.0) / 4_294_967_296.0
    }

    fn episode(&mut self, n: usize) -> Vec<f64> {
        let (mut angle, mut walk, mut held) = (self.next(), self.next(), 0.0);
        let mut rows = Vec::new();
        for t in 0..n {
            angle += (self.next() - 0.375) * 0.5;
            walk += (self.next() - 0.5) * 0.125;
            let fresh = self.next();
            if t % 16 < 8 {
                held = fresh;
            }
            rows.extend([angle - 6.25 * ((angle + 3.125) / 6.25).floor(), walk, held]);
        }
        rows
    }
}

#[track_caller]
fn check(place: &str, got: &Value, expected: &Value, tolerance: f64) {
    for (key, want) in expected.as_object().unwrap() {
        match (got[key].as_f64(), want.as_f64()) {
            (Some(got), Some(want)) => {
                assert!(
                    (got - want).abs() <= tolerance * (1.0 + want.abs()),
                    "{place} {key}: expected {want}, got {got}"
                );
            }
            _ => assert_eq!(&got[key], want, "{place} {key}"),
        }
    }
}

#[test]
fn statistics_are_those_of_numpy() {
    let golden: Value = serde_json::from_str(include_str!("golden/statistics.json")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("out");
    let schema: gawm_schema::Schema = toml::from_str(SCHEMA).unwrap();
    let mut writer =
        DatasetWriter::create(&dir, DatasetSpec::new(schema.clone(), "", "test 1"), WriteMode::New).unwrap();
    let content_hash = gawm_schema::ContentHash::of(b"log");
    writer
        .begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: BTreeMap::new() })
        .unwrap();
    let mut uniform = Uniform(12_345);
    let mut all = Vec::new();
    for length in golden["lengths"].as_array().unwrap() {
        let n = length.as_u64().unwrap() as usize;
        let values = uniform.episode(n);
        all.extend(values.clone());
        let rows = Rows {
            time_ns: (0..n as i64).map(|t| t * 50_000_000).collect(),
            vectors: vec![VectorColumn { values, valid: vec![true; n] }],
            ..Rows::default()
        };
        writer.begin_episode(EpisodeInfo::default()).unwrap();
        writer.write(Trajectory::try_new(&schema, rows).unwrap()).unwrap();
        writer.end_episode().unwrap();
    }
    writer.end_recording().unwrap();
    writer.finish().unwrap();

    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let stats = dataset_stats(&dataset).unwrap();
    let got = to_json(&stats, &BTreeMap::new());
    for dim in 0..3 {
        let (ours, numpy) = (&got["columns"]["observation.state"][dim], &golden["total"][dim]);
        let place = format!("dim {dim}");
        check(&place, &ours["summary"], &numpy["summary"], 1e-12);
        check(&place, &ours["motion"], &numpy["motion"], 1e-9);
        if !numpy["circular"].is_null() {
            check(&place, &ours["circular"], &numpy["circular"], 1e-12);
        }
        // Every value lies in its bin of the histogram.
        let histogram = &ours["histogram"];
        let (start, width) = (histogram["start"].as_f64().unwrap(), histogram["bin_width"].as_f64().unwrap());
        let counts: Vec<u64> = serde_json::from_value(histogram["counts"].clone()).unwrap();
        let mut counted = vec![0; counts.len()];
        all.iter().skip(dim).step_by(3).for_each(|v| counted[((v - start) / width).floor() as usize] += 1);
        assert_eq!(counts, counted, "histogram of dim {dim}");
        for (episode, numpy) in golden["episodes"].as_array().unwrap().iter().enumerate() {
            let ours = &got["episodes"][episode]["columns"]["observation.state"][dim];
            let place = format!("episode {episode} dim {dim}");
            check(&place, ours, &numpy[dim]["summary"], 1e-12);
            check(&place, ours, &numpy[dim]["motion"], 1e-9);
        }
    }
    for (dim, numpy) in golden["encoded"].as_array().unwrap().iter().enumerate() {
        // Sines differ between libraries in the last bit of float32.
        check(&format!("encoded {dim}"), &got["columns"]["gawm.state"][dim]["summary"], numpy, 1e-6);
    }
    let lerobot = lerobot_stats(&dataset, &stats, &BTreeMap::new());
    let numpy = &golden["total"];
    let list = |key: &str| json!([0, 1, 2].map(|dim| numpy[dim as usize]["summary"][key].clone()));
    let (ours, keys) = (&lerobot["observation.state"], ["mean", "std", "min", "max", "q01", "q50", "q99"]);
    for key in keys {
        for dim in 0..3 {
            let (a, b) = (ours[key][dim].as_f64().unwrap(), list(key)[dim].as_f64().unwrap());
            assert!((a - b).abs() <= 1e-12 * (1.0 + b.abs()), "stats.json {key} {dim}: {a} {b}");
        }
    }
    assert_eq!(ours["count"], json!([623]));
}
