//! The defects that are planted, each at a strength between 0 and 1.

use super::world::{Episode, JOINTS, Random, World, changed_frame, flat_frame, shifted_frame};

/// The episode that carries a defect of one episode.
const SICK: usize = 3;
/// The state that nothing commands.
const CABLE: usize = 14;

/// One kind of defect.
pub(super) struct Defect {
    pub(super) name: &'static str,
    /// The rule that must find it.
    pub(super) code: &'static str,
    /// The episode it must be found in, if it concerns one.
    pub(super) episode: Option<i64>,
    pub(super) plant: fn(&mut World, f64),
}

impl Defect {
    /// Returns whether the defect is in pictures.
    pub(super) fn needs_cameras(&self) -> bool {
        self.code.starts_with("IMAGE")
    }
}

const fn here(name: &'static str, code: &'static str, plant: fn(&mut World, f64)) -> Defect {
    Defect { name, code, episode: Some(SICK as i64), plant }
}

const fn whole(name: &'static str, code: &'static str, plant: fn(&mut World, f64)) -> Defect {
    Defect { name, code, episode: None, plant }
}

/// All defects.
pub(super) const DEFECTS: &[Defect] = &[
    whole("declared column missing", "STRUCT-007", |w, s| {
        w.folder.dropped_column = Some(if s < 0.5 {
            "observation.heading"
        } else if s < 0.9 {
            "action"
        } else {
            "index"
        });
    }),
    whole("undeclared column", "STRUCT-008", |w, s| {
        w.folder.extra_column = Some(if s < 0.5 {
            "note"
        } else if s < 0.9 {
            "observation.extra"
        } else {
            "action_2"
        });
    }),
    whole("column of another type", "STRUCT-009", |w, s| {
        w.folder.action_dtype = Some(if s < 0.5 {
            "int64"
        } else if s < 0.9 {
            "bool"
        } else {
            "string"
        });
    }),
    here("null rows", "STRUCT-010", |w, s| w.episodes[SICK].null_states = (50..50 + up_to(s, 10)).collect()),
    here("lists of the wrong length", "STRUCT-011", |w, s| {
        w.episodes[SICK].short_states = (60..60 + up_to(s, 10)).collect()
    }),
    here("episodes out of order", "STRUCT-012", |w, s| {
        let mut order: Vec<usize> = (0..w.episodes.len()).collect();
        let moved = order.remove(SICK);
        order.insert(SICK + up_to(s, 4), moved);
        w.folder.order = Some(order);
    }),
    whole("wrong frame count", "STRUCT-013", |w, s| w.folder.extra_frames = up_to(s, 500) as i64),
    here("wrong episode length", "STRUCT-014", |w, s| {
        w.folder.extra_length = vec![(SICK, -(up_to(s, 40) as i64))]
    }),
    whole("task table without index", "STRUCT-015", |w, _| w.folder.without_pandas = true),
    here("broken global index", "STRUCT-017", |w, s| {
        let n = w.episodes[SICK].n_rows();
        w.episodes[SICK].index_shift[n - up_to(s, 100)..].fill(up_to(s, 20) as i64);
    }),
    here("hole in frame_index", "STRUCT-018", |w, s| {
        let by = up_to(s, 8) as i64;
        w.episodes[SICK].frame_index[100..].iter_mut().for_each(|f| *f += by);
    }),
    here("unknown task", "STRUCT-019", |w, s| w.episodes[SICK].task_index[..up_to(s, 100)].fill(7)),
    whole("stale statistics", "STRUCT-020", |w, s| w.folder.stats_shift = 0.5 * s),
    whole("statistics that are no JSON", "STRUCT-002", |w, _| w.folder.garbled_meta = true),
    whole("data file cut off", "STRUCT-005", |w, s| w.folder.cut_bytes = Some(0.5 * s)),
    whole("path that leaves the folder", "STRUCT-003", |w, s| {
        let path = if s < 0.5 {
            "../data/file-{file_index:03d}.parquet"
        } else if s < 0.9 {
            "/tmp/file-{file_index:03d}.parquet"
        } else {
            "data/../../../x.parquet"
        };
        w.folder.data_path = Some(path.to_owned());
    }),
    here("equal times", "TIME-001", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 5), |e, t| e.time_ns[t] = e.time_ns[t - 1])
    }),
    here("backward time", "TIME-002", |w, s| {
        let back = (s * 2e9) as i64;
        w.episodes[SICK].time_ns[120..].iter_mut().for_each(|t| *t -= back);
    }),
    here("gap", "TIME-003", |w, s| {
        let gap = (s * 1e9) as i64;
        w.episodes[SICK].time_ns[120..].iter_mut().for_each(|t| *t += gap);
    }),
    here("timestamps off the grid", "TIME-004", |w, s| {
        w.episodes[SICK].timestamp[80..].iter_mut().for_each(|t| *t += 0.03 * s);
    }),
    here("drifting clock", "TIME-005", |w, s| stretch_time(&mut w.episodes[SICK], 1.0 + 3e-3 * s)),
    here("another rate", "TIME-006", |w, s| stretch_time(&mut w.episodes[SICK], 1.0 + 0.4 * s)),
    here("jitter", "TIME-007", |w, s| {
        let mut random = Random(5);
        w.episodes[SICK].time_ns.iter_mut().for_each(|t| *t += (random.normal() * s * 8e6) as i64);
    }),
    here("squeezed time", "TIME-008", |w, s| w.episodes[SICK].remove_rows(100, 100 + up_to(s, 12))),
    here("repeated rows in motion", "TIME-009", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 6), |e, t| {
            let groups = [&mut e.state, &mut e.action, &mut e.heading, &mut e.six];
            groups.into_iter().flatten().for_each(|dim| dim[t] = dim[t - 1]);
        });
    }),
    here("samples from the future", "TIME-010", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 20), |e, t| e.age_ms[1][t] = -30.0)
    }),
    here("stale samples", "TIME-011", |w, s| {
        (0..up_to(s, 40)).for_each(|k| w.episodes[SICK].age_ms[1][90 + k] = 350.0 + 33.0 * k as f64);
    }),
    here("drifting stream", "TIME-012", |w, s| {
        w.episodes[SICK].arrival_age_ms[1].iter_mut().enumerate().for_each(|(t, a)| *a += s * t as f64 * 0.1);
    }),
    here("stamps of another clock", "TIME-013", |w, s| {
        w.episodes[SICK].arrival_age_ms[0].iter_mut().for_each(|a| *a -= s * 36e5)
    }),
    here("undecodable frames", "IMAGE-001", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 5), |e, t| {
            let cut = e.frames[0][t].as_ref().map(|f| f.slice(..f.len() / 2));
            e.frames[0][t] = cut;
        });
    }),
    here("missing frames", "IMAGE-002", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 5), |e, t| e.frames[1][t] = None)
    }),
    here("frames of another size", "IMAGE-003", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 5), |e, t| e.frames[0][t] = Some(flat_frame(90, 2)))
    }),
    here("black frames", "IMAGE-004", |w, s| {
        w.episodes[SICK].frames[0][70..70 + up_to(s, 12)].fill(Some(flat_frame(2, 1)))
    }),
    here("white frames", "IMAGE-005", |w, s| {
        w.episodes[SICK].frames[0][70..70 + up_to(s, 12)].fill(Some(flat_frame(254, 1)))
    }),
    here("frozen camera", "IMAGE-006", |w, s| {
        let frame = w.episodes[SICK].frames[1][70].clone();
        w.episodes[SICK].frames[1][70..70 + 8 + up_to(s, 50)].fill(frame);
    }),
    here("repeated frames", "IMAGE-007", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 8), |e, t| {
            let frame = e.frames[0][t - 1].clone();
            e.frames[0][t] = frame;
        });
    }),
    here("foreign frames", "IMAGE-008", |w, s| {
        each(&mut w.episodes[SICK], up_to(s, 2), |e, t| {
            let frame = e.frames[1][t].clone();
            e.frames[0][t] = frame;
        });
    }),
    here("exchanged cameras", "IMAGE-009", |w, s| {
        let n = w.episodes[SICK].n_rows();
        let share = (n as f64 * (0.7 + 0.3 * s)) as usize;
        let (front, wrist) = w.episodes[SICK].frames.split_at_mut(1);
        front[0][..share].swap_with_slice(&mut wrist[0][..share]);
    }),
    here("camera moved", "IMAGE-021", |w, s| {
        let rows = up_to(s, 7);
        w.episodes[SICK].frames[0].iter_mut().flatten().for_each(|f| *f = shifted_frame(f, rows));
    }),
    here("dark episode", "IMAGE-010", |w, s| {
        for frame in w.episodes[SICK].frames[0].iter_mut().flatten() {
            *frame = changed_frame(frame, |v| (f64::from(v) * (1.0 - 0.7 * s)) as u8);
        }
    }),
    here("NaN", "VALUE-001", |w, s| w.episodes[SICK].state[2][90..90 + up_to(s, 10)].fill(f64::NAN)),
    here("infinite", "VALUE-001", |w, s| {
        w.episodes[SICK].action[1][90..90 + up_to(s, 10)].fill(f64::INFINITY)
    }),
    here("stuck signal", "VALUE-003", |w, s| {
        let level = w.episodes[SICK].state[1][80];
        w.episodes[SICK].state[1][80..80 + 10 + up_to(s, 60)].fill(level);
    }),
    here("all signals stuck", "VALUE-003", |w, s| {
        for dim in w.episodes[SICK].state.iter_mut() {
            let level = dim[80];
            dim[80..80 + 10 + up_to(s, 40)].fill(level);
        }
    }),
    here("saturated signal", "VALUE-004", |w, s| {
        let mut sorted = w.episodes[SICK].state[1].clone();
        sorted.sort_by(f64::total_cmp);
        let level = sorted[(sorted.len() as f64 * (1.0 - 0.3 * s)) as usize - 1];
        w.episodes[SICK].state[1].iter_mut().for_each(|v| *v = v.min(level));
    }),
    here("jump", "VALUE-005", |w, s| w.episodes[SICK].state[2][110..].iter_mut().for_each(|v| *v += 0.6 * s)),
    here("spike", "VALUE-005", |w, s| w.episodes[SICK].state[2][110] += 0.6 * s),
    here("degrees under a radian label", "VALUE-006", |w, s| {
        let n = up_to(s, JOINTS);
        w.episodes[SICK].state[..n].iter_mut().flatten().for_each(|v| *v = v.to_degrees());
    }),
    here("wrapped angle declared linear", "VALUE-007", |w, s| {
        let pi = std::f64::consts::PI;
        let n = w.episodes[SICK].n_rows();
        let turn =
            move |t: usize| (0.5 + t as f64 / n as f64 * (4.0 + 10.0 * s) + pi).rem_euclid(2.0 * pi) - pi;
        w.episodes[SICK].state[4] = (0..n).map(turn).collect();
    }),
    here("quaternion of wrong length", "VALUE-008", |w, s| {
        w.episodes[SICK].state[10..14].iter_mut().flatten().for_each(|v| *v *= 1.0 + 0.2 * s);
    }),
    here("quaternion sign flips", "VALUE-009", |w, s| {
        let from = 100;
        let to = from + up_to(s, 60);
        w.episodes[SICK].state[10..14].iter_mut().for_each(|d| d[from..to].iter_mut().for_each(|v| *v = -*v));
    }),
    here("sine and cosine apart", "VALUE-010", |w, s| {
        w.episodes[SICK].heading[0][60..60 + up_to(s, 100)].iter_mut().for_each(|v| *v *= 1.0 + 0.3 * s)
    }),
    here("6-D rotation not orthonormal", "VALUE-011", |w, s| {
        w.episodes[SICK].six[3][60..60 + up_to(s, 100)].iter_mut().for_each(|v| *v += 0.2 * s)
    }),
    here("episode on another scale", "VALUE-013", |w, s| {
        let factor = 1000f64.powf(s);
        w.episodes[SICK].state[..10].iter_mut().flatten().for_each(|v| *v *= factor);
    }),
    here("burst of noise", "VALUE-015", |w, s| {
        let mut random = Random(3);
        w.episodes[SICK].state[0][96..96 + 48].iter_mut().for_each(|v| *v += 0.15 * s * random.normal());
    }),
    here("readings of zero", "VALUE-018", |w, s| {
        let mut rows: Vec<usize> = (20..180).collect();
        rows.sort_by(|a, b| {
            w.episodes[SICK].state[0][*b].abs().total_cmp(&w.episodes[SICK].state[0][*a].abs())
        });
        rows.into_iter().step_by(9).take(up_to(s, 6)).for_each(|t| w.episodes[SICK].state[0][t] = 0.0);
    }),
    here("shifted actions", "SEMANTIC-001", |w, s| {
        let by = up_to(s, 3);
        w.episodes[SICK].action.iter_mut().for_each(|d| d.rotate_right(by));
    }),
    whole("all actions a step late", "SEMANTIC-001", |w, s| {
        let by = up_to(s, 2);
        w.episodes.iter_mut().flat_map(|e| &mut e.action).for_each(|d| d.rotate_right(by));
    }),
    here("permuted joints", "SEMANTIC-002", |w, s| {
        let n = 1 + up_to(s, 3);
        w.episodes[SICK].action[..n].rotate_left(1);
    }),
    whole("joints permuted in all episodes", "SEMANTIC-002", |w, s| {
        let n = 1 + up_to(s, 3);
        w.episodes.iter_mut().for_each(|e| e.action[..n].rotate_left(1));
    }),
    here("differences labelled absolute", "SEMANTIC-003", |w, s| {
        let n = if s < 0.5 { 4 } else { JOINTS };
        w.episodes[SICK].action[..n].iter_mut().for_each(to_steps);
    }),
    here("dead signal", "SEMANTIC-004", |w, s| {
        w.episodes[SICK].state[..up_to(s, 4)].iter_mut().for_each(|d| d.fill(0.25))
    }),
    here("actions of another episode", "SEMANTIC-005", |w, s| {
        let n = w.episodes[SICK].n_rows();
        let other = w.episodes[5].action.clone();
        let kept = (n as f64 * 0.2 * (1.0 - s)) as usize;
        for (mine, theirs) in w.episodes[SICK].action.iter_mut().zip(other) {
            (kept..n).for_each(|t| mine[t] = theirs[t % theirs.len()]);
        }
    }),
    here("opposite sign", "SEMANTIC-007", |w, s| {
        w.episodes[SICK].action[..up_to(s, 3)].iter_mut().flatten().for_each(|v| *v = -*v)
    }),
    here("actions on another scale", "SEMANTIC-008", |w, s| {
        w.episodes[SICK].action[..up_to(s, 4)].iter_mut().flatten().for_each(|v| *v = v.to_degrees());
    }),
    here("joint zero moved", "SEMANTIC-014", |w, s| {
        w.episodes[SICK].state[3].iter_mut().for_each(|v| *v += 0.8 * s)
    }),
    here("signal late against the others", "SEMANTIC-016", |w, s| {
        let cable = &mut w.episodes[SICK].state[CABLE];
        let by = up_to(s, 8);
        let n = cable.len();
        cable.copy_within(..n - by, by);
    }),
    here("signal drifts against the others", "SEMANTIC-016", |w, s| {
        let cable = &mut w.episodes[SICK].state[CABLE];
        let n = cable.len() as f64;
        cable.iter_mut().enumerate().for_each(|(t, v)| *v += 0.4 * s * t as f64 / n);
    }),
    here("signal scaled or mirrored against the others", "SEMANTIC-016", |w, s| {
        w.episodes[SICK].state[CABLE].iter_mut().for_each(|v| *v = 0.6 + (*v - 0.6) * (1.0 - 2.0 * s));
    }),
    whole("task without text", "SEMANTIC-006", |w, s| {
        w.tasks[1] = if s < 0.5 { "task 2" } else { "" }.to_owned()
    }),
    whole("few windows survive", "SEMANTIC-013", |w, s| {
        let step = if s < 0.5 { 28 } else { 12 };
        w.episodes.iter_mut().for_each(|e| e.state[0].iter_mut().step_by(step).for_each(|v| *v = f64::NAN));
    }),
    Defect {
        name: "episode twice",
        code: "SPLIT-001",
        episode: Some(5),
        plant: |w, _| copy_motion(w, SICK, 5),
    },
    Defect {
        name: "episode nearly twice",
        code: "SPLIT-002",
        episode: Some(5),
        plant: |w, s| {
            copy_motion(w, SICK, 5);
            let mut random = Random(9);
            let size = 1e-3 * (1.3 - s);
            w.episodes[5].state[..JOINTS].iter_mut().flatten().for_each(|v| *v += size * random.normal());
        },
    },
    whole("session on both sides", "SPLIT-003", |w, s| {
        let n = up_to(s, 3);
        (0..n).for_each(|k| w.episodes[7 - k].session = "session-1".to_owned());
    }),
    whole("split beyond the end", "SPLIT-004", |w, s| {
        w.folder.splits = Some(format!("0:{}", w.episodes.len() + up_to(s, 50)))
    }),
    Defect {
        name: "copy on the other side",
        code: "SPLIT-006",
        episode: Some(7),
        plant: |w, _| copy_motion(w, SICK, 7),
    },
    Defect {
        name: "copies with different labels",
        code: "SPLIT-007",
        episode: Some(5),
        plant: |w, _| {
            copy_motion(w, SICK, 5);
            w.episodes[5].success = false;
        },
    },
    Defect {
        name: "recording cut twice",
        code: "SPLIT-008",
        episode: Some(5),
        plant: |w, s| {
            let n = w.episodes[SICK].n_rows().min(w.episodes[5].n_rows());
            let shared = (n as f64 * (0.2 + 0.5 * s)) as usize;
            let source = w.episodes[SICK].clone();
            let start = source.n_rows() - shared;
            let copy = |to: &mut Vec<Vec<f64>>, from: &Vec<Vec<f64>>| {
                to.iter_mut()
                    .zip(from)
                    .for_each(|(a, b)| a[..shared].copy_from_slice(&b[start..start + shared]));
            };
            copy(&mut w.episodes[5].state, &source.state);
            copy(&mut w.episodes[5].action, &source.action);
        },
    },
];

/// Returns the share `strength` of `most`, at least 1.
fn up_to(strength: f64, most: usize) -> usize {
    ((strength * most as f64).round() as usize).max(1)
}

/// Changes `n` rows of an episode, far from each other.
fn each(episode: &mut Episode, n: usize, change: impl Fn(&mut Episode, usize)) {
    (0..n).for_each(|k| change(episode, 30 + 17 * (k % 9) + k / 9));
}

fn stretch_time(episode: &mut Episode, factor: f64) {
    let start = episode.time_ns[0];
    episode.time_ns.iter_mut().for_each(|t| *t = start + ((*t - start) as f64 * factor) as i64);
}

fn to_steps(values: &mut Vec<f64>) {
    let steps = values.windows(2).map(|w| w[1] - w[0]);
    let mut out: Vec<f64> = steps.collect();
    out.push(*out.last().unwrap_or(&0.0));
    *values = out;
}

/// Makes the motion of episode `to` that of episode `from`.
fn copy_motion(world: &mut World, from: usize, to: usize) {
    let source = world.episodes[from].clone();
    let target = &mut world.episodes[to];
    let shift = target.time_ns[0] - source.time_ns[0];
    let (session, split, success) = (target.session.clone(), target.split.clone(), target.success);
    *target = source;
    (target.session, target.split, target.success) = (session, split, success);
    target.time_ns.iter_mut().for_each(|t| *t += shift);
}
