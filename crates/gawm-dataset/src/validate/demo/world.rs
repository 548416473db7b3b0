//! A clean synthetic robot: an arm that follows its commands, two cameras, clocks, labels.

use std::f64::consts::TAU;

use bytes::Bytes;

use gawm_image::{Limits, Thumbnail, decode_thumbnail, encode_png};

/// Frames per second of the synthetic robot.
pub(super) const FPS: f64 = 30.0;
/// Joints of the arm.
pub(super) const JOINTS: usize = 6;
/// Side of a frame in pixels.
const FRAME_SIDE: usize = 32;

/// Names of the state's dims; the first seven are also those of the action.
pub(super) const STATE_NAMES: [&str; 15] = [
    "shoulder_pan.pos",
    "shoulder_lift.pos",
    "elbow.pos",
    "wrist_1.pos",
    "wrist_2.pos",
    "wrist_3.pos",
    "gripper.pos",
    "tool.x",
    "tool.y",
    "tool.z",
    "tool_quat.x",
    "tool_quat.y",
    "tool_quat.z",
    "tool_quat.w",
    "cable.length",
];

/// A generator of pseudo-random numbers with a fixed sequence (SplitMix64).
#[derive(Debug, Clone)]
pub(super) struct Random(pub(super) u64);

impl Random {
    pub(super) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Returns a number in [0, 1).
    pub(super) fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a number of mean 0 and standard deviation 1 (sum of twelve uniforms).
    pub(super) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}

/// One episode; vectors of dims are [dim][row].
#[derive(Debug, Clone)]
pub(super) struct Episode {
    pub(super) state: Vec<Vec<f64>>,
    pub(super) action: Vec<Vec<f64>>,
    pub(super) heading: Vec<Vec<f64>>,
    pub(super) six: Vec<Vec<f64>>,
    pub(super) timestamp: Vec<f64>,
    pub(super) frame_index: Vec<i64>,
    pub(super) index_shift: Vec<i64>,
    pub(super) task_index: Vec<i64>,
    pub(super) time_ns: Vec<i64>,
    pub(super) age_ms: Vec<Vec<f64>>,
    pub(super) arrival_age_ms: Vec<Vec<f64>>,
    /// Per camera the frames; empty without cameras.
    pub(super) frames: Vec<Vec<Option<Bytes>>>,
    pub(super) success: bool,
    pub(super) session: String,
    pub(super) split: String,
    /// Rows whose state is null, or one value short.
    pub(super) null_states: Vec<usize>,
    pub(super) short_states: Vec<usize>,
}

impl Episode {
    pub(super) fn n_rows(&self) -> usize {
        self.frame_index.len()
    }

    /// Removes rows `from..to` and numbers the rest as if nothing had been there.
    pub(super) fn remove_rows(&mut self, from: usize, to: usize) {
        fn cut<T>(values: &mut Vec<T>, from: usize, to: usize) {
            values.drain(from..to);
        }
        let groups = [
            &mut self.state,
            &mut self.action,
            &mut self.heading,
            &mut self.six,
            &mut self.age_ms,
            &mut self.arrival_age_ms,
        ];
        groups.into_iter().flatten().for_each(|dim| cut(dim, from, to));
        self.frames.iter_mut().for_each(|camera| cut(camera, from, to));
        let n = self.n_rows() - (to - from);
        self.timestamp.truncate(n);
        self.frame_index.truncate(n);
        self.index_shift.truncate(n);
        self.task_index.truncate(n);
        self.time_ns.truncate(n);
    }
}

/// A dataset in memory, and what its folder says beside the rows.
#[derive(Debug, Clone)]
pub(super) struct World {
    pub(super) episodes: Vec<Episode>,
    pub(super) tasks: Vec<String>,
    pub(super) folder: Folder,
}

/// Deviations of the folder from what the rows call for.
#[derive(Debug, Clone, Default)]
pub(super) struct Folder {
    pub(super) dropped_column: Option<&'static str>,
    pub(super) extra_column: Option<&'static str>,
    pub(super) extra_frames: i64,
    pub(super) extra_length: Vec<(usize, i64)>,
    pub(super) cut_bytes: Option<f64>,
    pub(super) data_path: Option<String>,
    pub(super) stats_shift: f64,
    pub(super) splits: Option<String>,
    pub(super) order: Option<Vec<usize>>,
    pub(super) action_dtype: Option<&'static str>,
    pub(super) without_pandas: bool,
    pub(super) garbled_meta: bool,
}

/// Makes a clean dataset.
pub(super) fn clean_world(seed: u64, has_cameras: bool) -> World {
    let mut random = Random(seed.wrapping_mul(0x5851_f42d_4c95_7f2d) ^ 0x1405_7b7e_f767_814f);
    let episodes = (0..8).map(|i| episode(&mut random, i, has_cameras)).collect();
    let tasks =
        vec!["put the red cube on the blue plate".to_owned(), "open the upper drawer of the desk".to_owned()];
    World { episodes, tasks, folder: Folder::default() }
}

fn episode(random: &mut Random, number: usize, has_cameras: bool) -> Episode {
    let n = 200 + (random.next() % 60) as usize;
    let targets: Vec<Vec<f64>> = (0..=JOINTS).map(|_| target(random, n)).collect();
    let mut action: Vec<Vec<f64>> = targets;
    // The gripper opens and closes: between 0 and 1, at rest in between.
    action[JOINTS] = action[JOINTS].iter().map(|v| (0.5 + 2.0 * v).clamp(0.0, 1.0)).collect();
    let mut state: Vec<Vec<f64>> = Vec::new();
    for command in &action {
        let mut position = command[0];
        let follow = command.iter().map(|a| {
            let here = position;
            position += 0.45 * (a - position) + 3e-4 * random.normal();
            here
        });
        state.push(follow.collect());
    }
    let tool = |t: usize, phase: f64| 0.3 * (state[0][t] + phase).sin() + 0.2 * (state[1][t] - phase).cos();
    let xyz: Vec<Vec<f64>> = [0.0, 1.0, 2.0].iter().map(|p| (0..n).map(|t| tool(t, *p)).collect()).collect();
    let quaternion = quaternions(&state);
    state.extend(xyz);
    state.extend(quaternion);
    // Nothing commands the cable: it follows from the joints.
    state.push((0..n).map(|t| 0.6 + 0.2 * state[0][t] - 0.15 * state[1][t] + 0.1 * state[2][t]).collect());
    let heading = (0..n).map(|t| 2.0 * state[2][t]).collect::<Vec<f64>>();
    let heading = vec![heading.iter().map(|a| a.sin()).collect(), heading.iter().map(|a| a.cos()).collect()];
    let six = six_dims(&state);
    let age: Vec<f64> = (0..n).map(|_| 4.0 + 8.0 * random.uniform()).collect();
    let camera_age: Vec<f64> = (0..n).map(|_| 10.0 + 20.0 * random.uniform()).collect();
    let delay = |ages: &Vec<f64>, random: &mut Random, ms: f64| -> Vec<f64> {
        ages.iter().map(|a| a - ms + 0.4 * random.normal()).collect()
    };
    let arrival_age_ms = vec![delay(&age, random, 1.0), delay(&camera_age, random, 6.0)];
    let frames = if has_cameras {
        (0..2).map(|c| (0..n).map(|t| Some(frame(c, &state, t, random))).collect()).collect()
    } else {
        Vec::new()
    };
    Episode {
        timestamp: (0..n).map(|t| t as f64 / FPS).collect(),
        frame_index: (0..n as i64).collect(),
        index_shift: vec![0; n],
        task_index: vec![(number % 2) as i64; n],
        time_ns: (0..n)
            .map(|t| {
                1_700_000_000_000_000_000 + number as i64 * 60_000_000_000 + (t as f64 / FPS * 1e9) as i64
            })
            .collect(),
        age_ms: vec![age, camera_age],
        arrival_age_ms,
        frames,
        success: true,
        session: format!("session-{}", number / 2),
        split: if number < 6 { "train" } else { "val" }.to_owned(),
        state,
        action,
        heading,
        six,
        null_states: Vec::new(),
        short_states: Vec::new(),
    }
}

/// A smooth command: a few slow waves of random phase.
fn target(random: &mut Random, n: usize) -> Vec<f64> {
    let waves: Vec<(f64, f64, f64)> = [(0.5, 0.2), (0.25, 0.5), (0.12, 1.1)]
        .into_iter()
        .map(|(size, hz)| {
            (
                size * (0.7 + 0.6 * random.uniform()),
                hz * (0.7 + 0.6 * random.uniform()),
                TAU * random.uniform(),
            )
        })
        .collect();
    let centre = 0.6 * (random.uniform() - 0.5);
    let at = |t: usize| {
        waves.iter().map(|(size, hz, phase)| size * (TAU * hz * t as f64 / FPS + phase).sin()).sum::<f64>()
    };
    (0..n).map(|t| centre + at(t) + 2e-4 * random.normal()).collect()
}

fn quaternions(state: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut out = vec![Vec::new(); 4];
    for ((a, b), c) in state[3].iter().zip(&state[4]).zip(&state[5]) {
        let q = [0.4 * a, 0.4 * b, 0.4 * c, 1.0];
        let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
        q.iter().zip(&mut out).for_each(|(v, dim)| dim.push(v / norm));
    }
    out
}

/// The first two columns of a rotation about two axes.
fn six_dims(state: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let mut out = vec![Vec::new(); 6];
    for (a, b) in state[3].iter().zip(&state[4]) {
        let rows = [a.cos(), a.sin(), 0.0, -a.sin() * b.cos(), a.cos() * b.cos(), b.sin()];
        rows.iter().zip(&mut out).for_each(|(v, dim)| dim.push(*v));
    }
    out
}

fn frame(camera: usize, state: &[Vec<f64>], t: usize, random: &mut Random) -> Bytes {
    let (cx, cy) =
        (FRAME_SIDE as f64 * (0.5 + 0.3 * state[0][t]), FRAME_SIDE as f64 * (0.5 + 0.3 * state[1][t]));
    let mut rgb = Vec::with_capacity(FRAME_SIDE * FRAME_SIDE * 3);
    for y in 0..FRAME_SIDE {
        for x in 0..FRAME_SIDE {
            let ground = if camera == 0 { 60.0 + 3.0 * y as f64 } else { 170.0 - 3.0 * x as f64 };
            let near = (-((x as f64 - cx).powi(2) + (y as f64 - cy).powi(2)) / 18.0).exp();
            let noise = (random.next() % 5) as f64 - 2.0;
            let level = ground + 70.0 * near + noise;
            rgb.extend([level as u8, (0.8 * level) as u8, (0.6 * level + 20.0) as u8]);
        }
    }
    encode(&Thumbnail { width: FRAME_SIDE, height: FRAME_SIDE, rgb })
}

/// Encodes a picture that is known to be sound.
pub(super) fn encode(picture: &Thumbnail) -> Bytes {
    let image = picture.to_image().expect("a buffer of the right size is an image");
    Bytes::from(encode_png(&image).expect("an image of 8 bits is always encoded"))
}

/// Returns a frame of one colour of the usual size times `scale`.
pub(super) fn flat_frame(level: u8, scale: usize) -> Bytes {
    let side = FRAME_SIDE * scale;
    encode(&Thumbnail { width: side, height: side, rgb: vec![level; side * side * 3] })
}

/// Decodes a frame that was made here, changes its bytes and encodes it again.
pub(super) fn changed_frame(bytes: &Bytes, change: impl Fn(u8) -> u8) -> Bytes {
    let (_, mut picture) = decode_thumbnail(bytes, 1, &Limits::default()).expect("frames of the demo decode");
    picture.rgb.iter_mut().for_each(|v| *v = change(*v));
    encode(&picture)
}

/// Decodes a frame that was made here, moves it up by some rows and encodes it again.
pub(super) fn shifted_frame(bytes: &Bytes, rows: usize) -> Bytes {
    let (_, mut picture) = decode_thumbnail(bytes, 1, &Limits::default()).expect("frames of the demo decode");
    picture.rgb.rotate_left(3 * FRAME_SIDE * rows);
    encode(&picture)
}
