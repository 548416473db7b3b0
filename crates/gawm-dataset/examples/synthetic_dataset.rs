//! Writes a small dataset of computed rows: `cargo run -p gawm-dataset --example synthetic_dataset -- OUT [FRAMES] [SIDE]`.
//!
//! Three episodes in two recordings of an arm with two joints, a gripper, a tool orientation and one camera, 10 Hz.
//! FRAMES (default 45) is the length of the longest episode, SIDE (default 64) that of the images; SIDE 0 has none.

use std::error::Error;
use std::path::Path;

use bytes::Bytes;
use gawm_dataset::{
    AgeColumns, DatasetSpec, DatasetWriter, EpisodeInfo, ImageColumn, RecordingInfo, Rows, SourceFile,
    Trajectory, VectorColumn, WriteMode,
};
use gawm_schema::{ContentHash, Schema};

const SCHEMA: &str = r#"
robot_type = "synthetic_arm"
rate_hz = 10.0
streams = [{ name = "joints", source = "/joint_states" }, { name = "front", source = "/front/image" }]

[[features]]
name = "observation.state"
role = "state"
data = { type = "vector", dtype = "float32", parts = [
    { kind = "angle", wrap = "none", dims = [
        { name = "shoulder", unit = "rad", source = "/joint_states:position[0]" },
        { name = "elbow", unit = "rad", source = "/joint_states:position[1]" },
    ] },
    { kind = "gripper", dims = [{ name = "gripper", unit = "m", source = "/joint_states:position[2]" }] },
    { kind = "quaternion", order = "xyzw", frame = "base", dims = [
        { name = "tool.qx", unit = "1", source = "/tool:orientation.x" },
        { name = "tool.qy", unit = "1", source = "/tool:orientation.y" },
        { name = "tool.qz", unit = "1", source = "/tool:orientation.z" },
        { name = "tool.qw", unit = "1", source = "/tool:orientation.w" },
    ] },
] }

[[features]]
name = "action"
role = "action"
data = { type = "vector", dtype = "float32", parts = [{ kind = "linear", dims = [
    { name = "shoulder", unit = "rad/s", source = "/command:velocity[0]" },
    { name = "elbow", unit = "rad/s", source = "/command:velocity[1]" },
] }] }

[[features]]
name = "intervention"
role = "annotation"
data = { type = "vector", dtype = "float32", parts = [{ kind = "bool", dims = [
    { name = "intervention", unit = "1", source = "/marker:data" },
] }] }
"#;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = arguments.next().ok_or("usage: synthetic_dataset OUT [FRAMES] [SIDE]")?;
    let n_frames: usize = arguments.next().map_or(Ok(45), |text| text.parse())?;
    let side: u32 = arguments.next().map_or(Ok(64), |text| text.parse())?;
    let mut schema: Schema = toml::from_str(SCHEMA)?;
    if side > 0 {
        let camera = format!(
            "name = \"observation.images.front\"\nrole = \"image\"\n\
             data = {{ type = \"image\", height = {side}, width = {side}, channels = 3 }}"
        );
        schema.features.push(toml::from_str(&camera)?);
    }
    let spec = DatasetSpec::new(schema.clone(), "# no contract: rows are computed\n", "synthetic_dataset");
    let mut writer = DatasetWriter::create(Path::new(&out), spec, WriteMode::New)?;
    for (number, lengths) in [vec![n_frames * 2 / 3, n_frames], vec![n_frames / 2]].into_iter().enumerate() {
        let hash = ContentHash::of(&[number as u8]);
        let file = SourceFile { name: format!("log-{number}.mcap"), content_hash: hash, length_bytes: 1 };
        let source = RecordingInfo { content_hash: hash, files: vec![file], notes: Default::default() };
        writer.begin_recording(source)?;
        for (i, n) in lengths.into_iter().enumerate() {
            writer.begin_episode(EpisodeInfo {
                task: ["put the red cube into the box", "open the upper drawer slowly"][(number + i) % 2]
                    .to_owned(),
                success: [Some(true), Some(false), None][number * 2 + i],
                session: format!("session-{number}"),
                ..EpisodeInfo::default()
            })?;
            for start in (0..n).step_by(256) {
                let rows = rows(number * 2 + i, start..(start + 256).min(n), n, side)?;
                writer.write(Trajectory::try_new(&schema, rows)?)?;
            }
            writer.end_episode()?;
        }
        writer.end_recording()?;
    }
    let summary = writer.finish()?;
    println!(
        "{} episodes, {} frames, {} bytes in {out}",
        summary.episodes, summary.frames, summary.data_bytes
    );
    Ok(())
}

fn rows(seed: usize, range: std::ops::Range<usize>, n: usize, side: u32) -> Result<Rows, Box<dyn Error>> {
    let column = |value: &dyn Fn(usize) -> Vec<f64>| VectorColumn {
        values: range.clone().flat_map(value).collect(),
        valid: vec![true; range.len()],
    };
    let angle = |i: usize| (i as f64 * 0.05 + seed as f64).sin() * 2.0;
    let state = column(&|i| {
        let half = angle(i) / 2.0;
        vec![angle(i), angle(i + 9), 0.02 + 0.02 * angle(i + 5).abs(), 0.0, 0.0, half.sin(), half.cos()]
    });
    let mut action = column(&|i| {
        let i = i.min(n - 2);
        vec![(angle(i + 1) - angle(i)) * 10.0, (angle(i + 10) - angle(i + 9)) * 10.0]
    });
    if range.end == n {
        action.valid[range.len() - 1] = false;
    }
    let intervention = column(&|i| vec![f64::from(u8::from(i % 17 < 3))]);
    let mut images = Vec::new();
    if side > 0 {
        let frames = range.clone().map(|i| image(i + seed * 7, side)).collect::<Result<_, _>>()?;
        images.push(ImageColumn { frames, valid: vec![true; range.len()] });
    }
    Ok(Rows {
        time_ns: range
            .clone()
            .map(|i| 1_700_000_000_000_000_000 + (seed * 1_000_000 + i) as i64 * 100_000_000)
            .collect(),
        vectors: vec![state, action, intervention],
        images,
        ages: AgeColumns {
            age_ms: range.clone().flat_map(|i| [(i % 10) as f32, 12.5]).collect(),
            arrival_age_ms: range.flat_map(|i| [(i % 10) as f32 + 1.0, 20.0]).collect(),
        },
    })
}

/// A gradient that moves with the frame, as PNG.
fn image(frame: usize, side: u32) -> Result<Bytes, png::EncodingError> {
    let mut pixels = Vec::with_capacity((side * side * 3) as usize);
    for y in 0..side {
        for x in 0..side {
            pixels.extend([(x as usize + frame) as u8, (y as usize * 2 + frame) as u8, (frame * 3) as u8]);
        }
    }
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, side, side);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(Bytes::from(bytes))
}
