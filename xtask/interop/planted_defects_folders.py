"""Plants defects of folders, sessions, rotations and pictures in clean LeRobot data, v3 or v2.1, and asks gawm-data for them.

    python planted_defects_folders.py GAWM_DATA SCRATCH_DIR [--v21] [DEFECT...]

Ten episodes of an arm with six joints, a gripper, a tool quaternion and a heading as sine and cosine; two JPEG cameras, five
sessions, two data files (v3). A line per defect: OK (a warning or an error that the clean folder does not have), note, or
MISS, with the codes found.
"""
import io, json, shutil, subprocess, sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

ARGS = [a for a in sys.argv[1:] if not a.startswith("--")]
PROGRAM, SCRATCH, ONLY = ARGS[0], Path(ARGS[1]), ARGS[2:]
IS_V21 = "--v21" in sys.argv
FPS, SIDE = 25, 40
JOINTS = [f"joint_{i}.pos" for i in range(6)] + ["gripper.pos"]
STATE = JOINTS + ["tool_quat.x", "tool_quat.y", "tool_quat.z", "tool_quat.w", "heading.sin", "heading.cos"]
CAMERAS = ["observation.images.front", "observation.images.wrist"]


def picture(camera, state, random):
    yy, xx = np.mgrid[0:SIDE, 0:SIDE]
    if camera == 0:
        base = 70 + 2.5 * yy + 70 * np.exp(-((xx - SIDE * (0.5 + 0.3 * state[0])) ** 2 + (yy - SIDE * (0.5 + 0.3 * state[1])) ** 2) / 40)
    else:
        base = 170 - 2 * xx + 40 * np.sin(xx / 6 + 3 * state[2]) * np.cos(yy / 7 + 3 * state[3])
    rgb = np.stack([base, 0.8 * base + 10, 0.5 * base + 20], -1) + random.normal(0, 2, (SIDE, SIDE, 3))
    return np.clip(rgb, 0, 255).astype(np.uint8)


def episode(random, k):
    n = int(random.integers(150, 220))
    t = np.arange(n) / FPS
    wave = lambda: sum(random.uniform(0.15, 0.45) * np.sin(2 * np.pi * random.uniform(0.08, 0.45) * t + random.uniform(0, 6)) for _ in range(3))
    command = np.stack([wave() + 0.2 * j for j in range(6)], 1)
    grip = np.convolve(np.pad((np.sin(2 * np.pi * 0.2 * t + random.uniform(0, 6)) > 0) * 0.05, (4, 0), "edge"), np.ones(5) / 5, "valid")
    action = np.c_[command, grip]
    state = np.empty_like(action)
    state[0] = action[0]
    for i in range(1, n):
        state[i] = state[i - 1] + 0.35 * (action[i - 1] - state[i - 1])
    state = state + random.normal(0, 4e-4, state.shape) * np.r_[np.ones(6), 0.01]
    half = 0.4 * state[:, 3:6]
    quat = np.c_[half, np.ones(n)]
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    heading = 2 * state[:, 2]
    state = np.c_[state, quat, np.sin(heading), np.cos(heading)]
    frames = [[picture(c, s, random) for s in state] for c in range(2)]
    return dict(state=state, action=action, frames=frames, ts=t.copy(), session=f"day{k // 2}", split="train" if k < 8 else "val",
                task="stack the blue block on the plate", success=bool(k % 3), frame=np.arange(n), index_shift=0, null=[])


def jpeg(pixels):
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=92)
    return buffer.getvalue()


def keep(e, rows):
    for key in ("state", "action", "ts", "frame"):
        e[key] = e[key][rows]
    e["frames"] = [[camera[i] for i in rows] for camera in e["frames"]]
    n = len(rows)
    e["ts"], e["frame"] = np.arange(n) / FPS, np.arange(n)


def rows_of(e, k, start):
    n = len(e["state"])
    column = {"timestamp": np.float32(e["ts"]).tolist(), "frame_index": e["frame"].tolist(), "episode_index": [k] * n,
              "index": (np.arange(start, start + n) + e["index_shift"]).tolist(), "task_index": [0] * n,
              "observation.state": [None if i in e["null"] else np.float32(s).tolist() for i, s in enumerate(e["state"])],
              "action": np.float32(e["action"]).tolist()}
    for name, frames in zip(CAMERAS, e["frames"]):
        column[name] = [None if f is None else dict(bytes=f if isinstance(f, bytes) else jpeg(f), path=None) for f in frames]
    return column


SCHEMA = pa.schema([("timestamp", pa.float32())] + [(k, pa.int64()) for k in ["frame_index", "episode_index", "index", "task_index"]]
                   + [(k, pa.list_(pa.float32())) for k in ["observation.state", "action"]]
                   + [(c, pa.struct([("bytes", pa.binary()), ("path", pa.string())])) for c in CAMERAS])


def statistics(values):
    values = values.astype(float)
    return {k: getattr(values, k)(0).tolist() for k in ("min", "max", "mean", "std")} | {"count": [len(values)]}


def write(episodes, folder, hook):
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    n = sum(len(e["state"]) for e in episodes)
    columns, table, start = [], [], 0
    for k, e in enumerate(episodes):
        columns.append(rows_of(e, k, start))
        length = len(e["state"])
        table.append({"episode_index": k, "tasks": [e["task"]], "length": length, "dataset_from_index": start, "dataset_to_index": start + length,
                      "data/chunk_index": 0, "data/file_index": int(k >= 5), "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
                      "success": e["success"], "session": e["session"], "split": e["split"]})
        start += length
    features = {"timestamp": dict(dtype="float32", shape=[1], names=None)}
    features |= {k: dict(dtype="int64", shape=[1], names=None) for k in ["frame_index", "episode_index", "index", "task_index"]}
    features["observation.state"] = dict(dtype="float32", shape=[len(STATE)], names=STATE, units=["rad"] * 6 + ["m"] + ["1"] * 6)
    features["action"] = dict(dtype="float32", shape=[len(JOINTS)], names=JOINTS, units=["rad"] * 6 + ["m"])
    for c in CAMERAS:
        features[c] = dict(dtype="image", shape=[SIDE, SIDE, 3], names=["height", "width", "channels"])
    stats = {"observation.state": statistics(np.concatenate([e["state"] for e in episodes])), "action": statistics(np.concatenate([e["action"] for e in episodes]))}
    stats |= {c: {k: [[[0.4]]] * 3 for k in ("min", "max", "mean", "std")} | {"count": [100]} for c in CAMERAS}
    info = dict(codebase_version="v2.1" if IS_V21 else "v3.0", robot_type="x", total_episodes=len(episodes), total_frames=n, total_tasks=1, total_chunks=1, total_videos=0,
                chunks_size=1000, fps=FPS, splits={"train": f"0:{len(episodes)}"}, video_path=None, features=features)
    if IS_V21:
        info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        shutil.rmtree(folder / "meta/episodes")
        for k, c in enumerate(columns):
            put(folder / f"data/chunk-000/episode_{k:06d}.parquet", [c])
        lines = lambda rows: "".join(json.dumps(r) + "\n" for r in rows)
        (folder / "meta/episodes.jsonl").write_text(lines({k: r[k] for k in ("episode_index", "tasks", "length", "success", "session", "split")} for r in table))
        (folder / "meta/tasks.jsonl").write_text(lines([dict(task_index=0, task=episodes[0]["task"])]))
        each = [{"episode_index": k, "stats": {"observation.state": statistics(e["state"]), "action": statistics(e["action"])}} for k, e in enumerate(episodes)]
        (folder / "meta/episodes_stats.jsonl").write_text(lines(each).replace("NaN", "0"))
    else:
        info |= dict(data_files_size_in_mb=100, video_files_size_in_mb=200, data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")
        put(folder / "data/chunk-000/file-000.parquet", columns[:5])
        put(folder / "data/chunk-000/file-001.parquet", columns[5:])
        pq.write_table(pa.Table.from_pylist(table), folder / "meta/episodes/chunk-000/file-000.parquet")
        pd.DataFrame(dict(task_index=[0]), index=pd.Index([episodes[0]["task"]], name="task")).to_parquet(folder / "meta/tasks.parquet")
    (folder / "meta/stats.json").write_text(json.dumps(stats).replace("NaN", "0").replace("Infinity", "0"))
    (folder / "meta/info.json").write_text(json.dumps(info))
    if hook:
        hook(folder)


def put(path, columns):
    writer = pq.ParquetWriter(path, SCHEMA)
    for c in columns:
        writer.write_table(pa.table({k: pa.array(v, SCHEMA.field(k).type) for k, v in c.items()}, schema=SCHEMA))
    writer.close()


def validate(folder, *options):
    done = subprocess.run([PROGRAM, "validate", str(folder), "--format", "json", "--fail-on", "never", *options], capture_output=True, text=True)
    try:
        return json.loads(done.stdout)["findings"]
    except json.JSONDecodeError:
        return [dict(code=f"EXIT-{done.returncode}", severity="error", episode=None, message=done.stderr.strip()[:200])]


DEFECTS = {}


def defect(function):
    DEFECTS[function.__name__] = function
    return function


def random():
    return np.random.default_rng(3)


def data_file(folder, k):
    return sorted((folder / "data").rglob("*.parquet"))[k]


def edit_table(k, change):
    def hook(folder):
        path = data_file(folder, k)
        pq.write_table(change(pq.read_table(path)), path)
    return hook


# Sessions and halves.
@defect
def permuted_in_one_session(E):
    for e in E[4:6]: e["action"][:, [1, 4]] = e["action"][:, [4, 1]]
@defect
def state_permuted_in_one_session(E):
    for e in E[4:6]: e["state"][:, [0, 2]] = e["state"][:, [2, 0]]
@defect
def three_joints_rotated_one_episode(E): E[7]["action"][:, [0, 1, 2]] = E[7]["action"][:, [1, 2, 0]]
@defect
def shifted_2_in_half(E):
    for e in E[::2]: e["action"] = np.r_[e["action"][:2], e["action"][:-2]]
@defect
def shifted_1_in_half(E):
    for e in E[5:]: e["action"] = np.r_[e["action"][:1], e["action"][:-1]]
@defect
def early_1_in_one(E): E[2]["action"] = np.r_[E[2]["action"][1:], E[2]["action"][-1:]]
@defect
def shifted_4_half_of_an_episode(E):
    a = E[2]["action"]; h = len(a) // 2; a[h:] = np.r_[a[h:h + 4], a[h:-4]]
@defect
def degrees_in_one_session(E):
    for e in E[4:6]: e["state"][:, :6] *= 57.29578; e["action"][:, :6] *= 57.29578
@defect
def degrees_one_joint_one_session(E):
    for e in E[4:6]: e["state"][:, 2] *= 57.29578; e["action"][:, 2] *= 57.29578
@defect
def gripper_mm_in_one_session(E):
    for e in E[4:6]: e["state"][:, 6] *= 1000; e["action"][:, 6] *= 1000
@defect
def deltas_in_one_session(E):
    for e in E[6:8]: e["action"][:, :6] = np.diff(e["state"][:, :6], axis=0, append=e["state"][-1:, :6])
@defect
def deltas_in_all(E):
    for e in E: e["action"] = np.diff(e["state"][:, :7], axis=0, append=e["state"][-1:, :7])
@defect
def action_is_state(E):
    for e in E: e["action"] = e["state"][:, :7].copy()
@defect
def action_zero_one_episode(E): E[5]["action"][:] = 0
@defect
def action_held_40_rows(E): E[5]["action"][60:100] = E[5]["action"][60]
@defect
def episode_reversed(E):
    for k in ("state", "action"): E[3][k] = E[3][k][::-1].copy()
    E[3]["frames"] = [f[::-1] for f in E[3]["frames"]]
@defect
def joint_offset_one_session(E):
    for e in E[2:4]: e["state"][:, 1] += 0.5
# Rotations and points on the circle.
@defect
def quaternion_flip_mid(E): E[1]["state"][90:, 7:11] *= -1
@defect
def quaternion_wxyz_one_session(E):
    for e in E[2:4]: e["state"][:, 7:11] = e["state"][:, [10, 7, 8, 9]]
@defect
def quaternion_norm(E): E[6]["state"][40:80, 7:11] *= 1.03
@defect
def circle_radius(E): E[6]["state"][:, 11:13] *= 1.1
@defect
def circle_sin_only(E): E[6]["state"][50:70, 11] = 0
@defect
def wrapped_declared_linear(E):
    for e in E: e["state"][:, 4] = (e["state"][:, 4] * 6 + np.pi) % (2 * np.pi) - np.pi
# Single signals.
@defect
def gripper_constant_one(E): E[3]["state"][:, 6] = 0.02
@defect
def gripper_constant_all(E):
    for e in E: e["state"][:, 6] = 0.02
@defect
def single_nan(E): E[8]["state"][77, 4] = np.nan
@defect
def saturated_in_one_session(E):
    for e in E[2:4]: e["state"][:, 1] = np.clip(e["state"][:, 1], -0.1, 0.4)
@defect
def dead_from_halfway(E): h = len(E[4]["state"]) // 2; E[4]["state"][h:, 3] = E[4]["state"][h, 3]
@defect
def held_at_half_rate(E): E[4]["state"][1::2, 0] = E[4]["state"][:-1:2, 0][:len(E[4]["state"][1::2])]
@defect
def quantised_one(E): E[1]["state"][:, 1] = np.round(E[1]["state"][:, 1] / 0.05) * 0.05
@defect
def noise_one_joint(E): E[2]["state"][:, 4] += random().normal(0, 0.01, len(E[2]["state"]))
@defect
def noise_burst(E): E[2]["state"][60:100, 4] += random().normal(0, 0.02, 40)
@defect
def spike_in_action(E): E[2]["action"][70, 3] += 1.2
@defect
def dropouts_to_zero(E): E[0]["state"][[33, 77, 101], 1] = 0
# Time.
@defect
def rows_lost_evenly_3_percent(E): keep(E[3], [i for i in range(len(E[3]["state"])) if i % 33 != 20])
@defect
def every_second_row_lost(E): keep(E[3], list(range(0, len(E[3]["state"]), 2)))
@defect
def five_rows_lost(E): keep(E[3], [i for i in range(len(E[3]["state"])) if not 80 <= i < 85])
@defect
def timestamps_squeezed_3_percent(E): E[3]["ts"] *= 0.97
@defect
def jitter_burst(E): E[3]["ts"][60:75] += random().uniform(-0.015, 0.015, 15)
@defect
def duplicated_rows(E): keep(E[3], sorted(list(range(len(E[3]["state"]))) + [50, 90, 91, 130]))
@defect
def timestamps_in_ms(E): E[3]["ts"] *= 1000
@defect
def timestamps_absolute(E): E[3]["ts"] += 1.7e9
# Pictures.
@defect
def frozen_1_s(E): E[2]["frames"][0][60:85] = [E[2]["frames"][0][60]] * 25
@defect
def frozen_1_s_noise(E):
    r = random()
    for i in range(60, 85): E[2]["frames"][0][i] = np.clip(E[2]["frames"][0][60].astype(int) + r.integers(-1, 2, (SIDE, SIDE, 3)), 0, 255).astype(np.uint8)
@defect
def frozen_to_the_end(E): f = E[2]["frames"][1]; f[90:] = [f[90]] * (len(f) - 90)
@defect
def black_from_halfway(E): f = E[2]["frames"][1]; h = len(f) // 2; f[h:] = [np.zeros((SIDE, SIDE, 3), np.uint8)] * (len(f) - h)
@defect
def single_black(E): E[2]["frames"][1][50] = np.zeros((SIDE, SIDE, 3), np.uint8)
@defect
def undecodable_single(E): E[2]["frames"][1][50] = jpeg(E[2]["frames"][1][50])[:300]
@defect
def bytes_are_no_picture(E): E[2]["frames"][1][50] = b"not a picture at all" * 9
@defect
def null_picture(E): E[2]["frames"][1][50] = None
@defect
def cameras_swapped_half_an_episode(E):
    a, b = E[4]["frames"]; h = len(a) // 2; a[h:], b[h:] = b[h:], a[h:]
@defect
def cameras_swapped_one_session(E):
    for e in E[4:6]: e["frames"].reverse()
@defect
def bgr_in_one_session(E):
    for e in E[4:6]: e["frames"][0] = [f[..., ::-1] for f in e["frames"][0]]
@defect
def blocks_of_frames_swapped(E): f = E[5]["frames"][0]; f[80:90], f[90:100] = f[90:100], f[80:90]
@defect
def same_picture_in_both_cameras(E): E[6]["frames"][1] = list(E[6]["frames"][0])
@defect
def pictures_of_another_episode(E): n = len(E[6]["frames"][0]); E[6]["frames"][0] = (E[7]["frames"][0] * 2)[:n]
@defect
def camera_late_5_rows(E): f = E[6]["frames"][0]; E[6]["frames"][0] = [f[0]] * 5 + f[:-5]
@defect
def rotated_camera_one_session(E):
    for e in E[4:6]: e["frames"][0] = [f[::-1, ::-1].copy() for f in e["frames"][0]]
@defect
def other_size_one_episode(E): E[6]["frames"][0] = [f[:20, :20] for f in E[6]["frames"][0]]
# Duplicates and splits.
@defect
def near_duplicate_noise(E):
    r = random(); E[9] |= {k: E[1][k] + r.normal(0, 1e-3, E[1][k].shape) for k in ("state", "action")} | {k: E[1][k] for k in ("frames", "ts", "frame")}
@defect
def near_duplicate_cut(E):
    s = slice(9, None); n = len(E[1]["state"]) - 9; r = random()
    E[9] |= dict(state=E[1]["state"][s] + r.normal(0, 1e-4, (n, len(STATE))), action=E[1]["action"][s], frames=[f[s] for f in E[1]["frames"]], ts=np.arange(n) / FPS, frame=np.arange(n))
@defect
def exact_duplicate_other_session(E): E[9] |= {k: E[1][k] for k in ("state", "action", "frames", "ts", "frame")}
@defect
def session_on_both_sides(E): E[8]["session"] = "day1"
@defect
def two_recordings_overlap(E):
    E[5]["state"][:60], E[5]["action"][:60] = E[4]["state"][-60:], E[4]["action"][-60:]
# Folders.
@defect
def null_rows(E): E[3]["null"] = list(range(40, 60))
@defect
def index_off_by_one_at_border(E):
    for e in E[5:]: e["index_shift"] = 1
@defect
def frame_index_from_one(E): E[6]["frame"] = E[6]["frame"] + 1
@defect
def missing_column_in_one_file(E): return edit_table(-1, lambda t: t.drop_columns(["action"]))
@defect
def missing_camera_in_one_file(E): return edit_table(-1, lambda t: t.drop_columns([CAMERAS[1]]))
@defect
def extra_column_in_one_file(E): return edit_table(-1, lambda t: t.append_column("debug", pa.array([1.0] * len(t))))
@defect
def another_type_in_one_file(E): return edit_table(-1, lambda t: t.set_column(t.column_names.index("action"), "action", pa.array([str(v) for v in t["action"].to_pylist()])))
@defect
def missing_file(E): return lambda d: data_file(d, -1).unlink()
@defect
def empty_file(E): return lambda d: data_file(d, -1).write_bytes(b"")
@defect
def last_rows_lost(E): return edit_table(-1, lambda t: t.slice(0, len(t) - 7))
@defect
def rows_shuffled(E): return edit_table(0, lambda t: t.take(random().permutation(len(t))))
@defect
def foreign_file(E): return lambda d: shutil.copy(data_file(d, 0), d / "data/chunk-000/copy.parquet")
@defect
def dim_names_exchanged(E):
    def hook(d):
        info = json.loads((d / "meta/info.json").read_text()); n = info["features"]["action"]["names"]; n[0], n[1] = n[1], n[0]
        (d / "meta/info.json").write_text(json.dumps(info))
    return hook
@defect
def wrong_fps(E):
    def hook(d):
        info = json.loads((d / "meta/info.json").read_text()); info["fps"] = 30
        (d / "meta/info.json").write_text(json.dumps(info))
    return hook
@defect
def wrong_shape(E):
    def hook(d):
        info = json.loads((d / "meta/info.json").read_text()); info["features"]["action"]["shape"] = [8]
        (d / "meta/info.json").write_text(json.dumps(info))
    return hook
@defect
def stats_of_another_dataset(E):
    def hook(d):
        p = d / ("meta/episodes_stats.jsonl" if IS_V21 else "meta/stats.json"); text = p.read_text().replace('"mean": [', '"mean": [9.5, ')
        p.write_text(text)
        stats = json.loads((d / "meta/stats.json").read_text()); stats["action"]["max"][0] += 3; (d / "meta/stats.json").write_text(json.dumps(stats))
    return hook
@defect
def tasks_missing(E): return lambda d: next(iter(sorted((d / "meta").glob("tasks*")))).unlink()
@defect
def episode_table_missing(E): return lambda d: (d / "meta/episodes.jsonl").unlink() if IS_V21 else shutil.rmtree(d / "meta/episodes")
@defect
def pictures_show_nothing(E):
    r = random()
    for e in E: e["frames"] = [[np.clip(120 + r.normal(0, 30, (SIDE, SIDE, 3)), 0, 255).astype(np.uint8) for _ in f] for f in e["frames"]]
    return "--probe"


def main():
    r = np.random.default_rng(1)
    base = [episode(r, k) for k in range(10)]
    clone = lambda: [dict(e, state=e["state"].copy(), action=e["action"].copy(), ts=e["ts"].copy(), frames=[list(f) for f in e["frames"]], null=[]) for e in base]
    write(base, SCRATCH / "clean", None)
    known = validate(SCRATCH / "clean")
    print("CLEAN:", [(f["code"], f["severity"], f["episode"], f["message"][:90]) for f in known])
    before = {(f["code"], f["episode"]) for f in known}
    hits = n = 0
    for name, plant in DEFECTS.items():
        if ONLY and name not in ONLY:
            continue
        episodes = clone()
        result = plant(episodes)
        write(episodes, SCRATCH / "x", result if callable(result) else None)
        found = [f for f in validate(SCRATCH / "x", *([result] if isinstance(result, str) else [])) if (f["code"], f["episode"]) not in before]
        loud = [f for f in found if f["severity"] in ("warning", "error")]
        n, hits = n + 1, hits + bool(loud)
        codes = {}
        for f in loud:
            codes.setdefault(f["code"], []).append(f["episode"])
        text = " ".join(f"{c}{sorted(set(e), key=str)[:6]}" for c, e in sorted(codes.items()))
        quiet = "" if loud else " ".join(sorted({f["code"] for f in found}))
        print(f"{'OK  ' if loud else ('note' if found else 'MISS')} {name:34s} {text[:230]}{quiet}", flush=True)
    print(hits, "of", n)


main()
