"""Plants defects in the numbers and pictures of recordings that other people made, and asks gawm-data for them.

    python planted_defects_corpora.py GAWM_DATA DATASETS SHARED SCRATCH_DIR [DEFECT...]

DATASETS is the scratch folder of healthy_datasets.py (ingested corpora). Columns that gawm adds are left out, so that what is
judged is a plain LeRobot v3 folder. A line per defect and recording: OK (a warning or an error that the unchanged recording
does not have, which names the episode or the whole dataset), note, or MISS, with the codes found.
"""
import io, json, shutil, subprocess, sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, ImageEnhance

PROGRAM, DATASETS, SHARED, SCRATCH, ONLY = sys.argv[1], *map(Path, sys.argv[2:5]), sys.argv[5:]
BASES = {
    "cart_pendulum": (DATASETS / "cart_pendulum_demo.hdf5/dataset", 40), "arm7dof": (DATASETS / "arm7dof_scripted_demos.hdf5/dataset", 10),
    "maze": (DATASETS / "d4rl_style_maze2d-umaze-v1.hdf5/dataset", 40), "gr1": (SHARED / "corpora/lerobot_v2_gr1_picknplace", 5),
    "arm_camera": (DATASETS / "generated_arm_protobuf.mcap/dataset", 6), "pusht": (DATASETS / "swm_h5_pusht.h5/dataset", 4),
}


def load(folder, n_episodes):
    info = json.loads((folder / "meta/info.json").read_text())
    names = [k for k, v in info["features"].items() if not k.startswith(("gawm.", "annotation.", "next.")) and v["dtype"] != "video"
             and k not in ("timestamp", "frame_index", "episode_index", "index", "task_index")]
    table = pa.concat_tables([pq.read_table(p, columns=["episode_index"] + names) for p in sorted((folder / "data").rglob("*.parquet"))])
    owner = table["episode_index"].to_numpy()
    vectors = {k: np.array(table[k].to_pylist(), float) for k in names if info["features"][k]["dtype"] != "image"}
    cameras = {k: table[k].to_pylist() for k in names if info["features"][k]["dtype"] == "image"}
    episodes = []
    for i in range(n_episodes):
        rows = np.flatnonzero(owner == i)
        e = {k: v[rows].reshape(len(rows), -1).copy() for k, v in vectors.items()}
        e |= {k: [v[r]["bytes"] for r in rows] for k, v in cameras.items()}
        e["ts"] = np.arange(len(rows)) / info["fps"]
        episodes.append(e)
    return info, list(vectors), list(cameras), episodes


def write(folder, base, episodes):
    info, vectors, cameras, _ = base
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "meta/episodes/chunk-000").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    columns = {k: [] for k in ["timestamp", "frame_index", "episode_index", "index", "task_index"] + vectors + cameras}
    table, start = [], 0
    for k, e in enumerate(episodes):
        n = len(e["ts"])
        columns["timestamp"] += e["ts"].tolist()
        columns["frame_index"] += range(n)
        columns["episode_index"] += [k] * n
        columns["index"] += range(start, start + n)
        columns["task_index"] += [0] * n
        for name in vectors:
            columns[name] += e[name].tolist() if info["features"][name]["shape"] != [1] else e[name][:, 0].tolist()
        for name in cameras:
            columns[name] += [dict(bytes=b, path=None) for b in e[name]]
        table.append({"episode_index": k, "tasks": ["move the object to the goal"], "length": n, "dataset_from_index": start, "dataset_to_index": start + n,
                      "data/chunk_index": 0, "data/file_index": 0, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        start += n
    types = {k: pa.float32() if info["features"][k]["shape"] == [1] else pa.list_(pa.float32()) for k in vectors}
    types |= {k: pa.struct([("bytes", pa.binary()), ("path", pa.string())]) for k in cameras}
    types |= {"timestamp": pa.float32()}
    fields = [(k, types.get(k, pa.int64())) for k in columns]
    pq.write_table(pa.table({k: pa.array(columns[k], t) for k, t in fields}), folder / "data/chunk-000/file-000.parquet")
    pq.write_table(pa.Table.from_pylist(table), folder / "meta/episodes/chunk-000/file-000.parquet")
    pq.write_table(pa.table({"task_index": [0], "task": ["move the object to the goal"]}), folder / "meta/tasks.parquet")
    scalar = lambda t: dict(dtype=t, shape=[1], names=None)
    features = {"timestamp": scalar("float32")} | {k: scalar("int64") for k in ["frame_index", "episode_index", "index", "task_index"]}
    features |= {k: {**info["features"][k], "dtype": "float32"} for k in vectors} | {k: info["features"][k] for k in cameras}
    written = dict(codebase_version="v3.0", robot_type=None, total_episodes=len(episodes), total_frames=start, total_tasks=1, chunks_size=1000,
                   data_files_size_in_mb=100, video_files_size_in_mb=200, fps=info["fps"], splits={"train": f"0:{len(episodes)}"},
                   data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", video_path=None, features=features)
    (folder / "meta/info.json").write_text(json.dumps(written))


STATE, ACTION = "observation.state", "action"
EPISODE = 2


def lively(e, key=STATE):
    """The dim that moves most evenly: its range over its largest step."""
    values = e[key]
    steps = np.abs(np.diff(values, axis=0)).max(0)
    score = np.where(values.std(0) > 1e-6, np.median(np.abs(np.diff(values, axis=0)), axis=0) / (values.std(0) + 1e-9), -1)
    return int(np.argmax(score)) if (steps > 0).any() else 0


def other(e, dim):
    spread = e[STATE].std(0).copy()
    spread[dim] = -1
    return int(np.argmax(spread))


def pixels(data):
    return Image.open(io.BytesIO(data)).convert("RGB")


def jpeg(image, quality=90):
    out = io.BytesIO()
    image.save(out, "JPEG", quality=quality)
    return out.getvalue()


def numbers(change):
    def plant(eps, cameras):
        e = eps[EPISODE]
        change(e, lively(e), len(e["ts"]), eps)
    return plant


def frames(change):
    def plant(eps, cameras):
        e = eps[EPISODE]
        e[cameras[0]] = change(e[cameras[0]], eps, cameras[0])
    return plant


def lagging_dim(e, d, n, eps):
    e[STATE][4:, d] = e[STATE][:-4, d].copy()


def drift(e, d, n, eps):
    e[STATE][:, d] += np.linspace(0, 0.6 * np.ptp(e[STATE][:, d]), n)


def swapped_states(e, d, n, eps):
    o = other(e, d)
    e[STATE][:, [d, o]] = e[STATE][:, [o, d]]


def mirrored(e, d, n, eps):
    e[STATE][:, d] *= -1


def gain(e, d, n, eps):
    e[STATE][:, d] *= 2


def overflow(e, d, n, eps):
    v = e[STATE][:, d]
    top = np.quantile(v, 0.8)
    v[v > top] -= np.ptp(v)


def held_actions(e, d, n, eps):
    e[ACTION] = e[ACTION][(np.arange(n) // 6) * 6]


def clipped_actions(e, d, n, eps):
    k = lively(e, ACTION)
    low, high = np.quantile(e[ACTION][:, k], [0.25, 0.75])
    e[ACTION][:, k] = e[ACTION][:, k].clip(low, high)


def late_border(e, d, n, eps):
    for key in (STATE, ACTION):
        e[key][:10] = eps[EPISODE - 1][key][-10:]


def decimal_slip(e, d, n, eps):
    e[STATE][n // 2, d] *= 10


def interleaved(e, d, n, eps):
    rows = np.arange(n // 3, n // 3 + 20, 2)
    e[STATE][rows] = eps[EPISODE + 1][STATE][rows]


def reversed_stretch(e, d, n, eps):
    a, b = n // 3, n // 3 + min(30, n // 3)
    e[STATE][a:b] = e[STATE][a:b][::-1].copy()


def zero_padding(e, d, n, eps):
    for key in (STATE, ACTION):
        e[key][-n // 4:] = 0


def unit_from_halfway(e, d, n, eps):
    e[STATE][n // 2:, d] *= 57.29578


def clock_gains(e, d, n, eps):
    e["ts"] *= 1.004


def copied_dim(e, d, n, eps):
    e[STATE][:, d] = e[STATE][:, other(e, d)]


def sentinel(e, d, n, eps):
    e[STATE][[n // 4, n // 2, 3 * n // 4], d] = -999.0


def shuffled_actions(e, d, n, eps):
    np.random.default_rng(1).shuffle(e[ACTION])


def added_sine(e, d, n, eps):
    e[STATE][:, d] += 0.15 * np.ptp(e[STATE][:, d]) * np.sin(np.arange(n) * np.pi * 0.9)


def actions_of_previous(e, d, n, eps):
    e[ACTION] = np.resize(eps[EPISODE - 1][ACTION], e[ACTION].shape)


def flicker(f, eps, c):
    return [jpeg(ImageEnhance.Brightness(pixels(b)).enhance(0.6)) if i % 2 else b for i, b in enumerate(f)]


def zoomed(f, eps, c):
    def zoom(image):
        w, h = image.size
        return image.crop((w // 6, h // 6, w - w // 6, h - h // 6)).resize((w, h))
    return [jpeg(zoom(pixels(b))) for b in f]


def blue_lost(f, eps, c):
    return [jpeg(Image.fromarray(np.array(pixels(b)) * np.array([1, 1, 0], np.uint8))) for b in f]


def poor_quality(f, eps, c):
    return [jpeg(pixels(b), 2) for b in f]


def mirrored_from_halfway(f, eps, c):
    return [jpeg(pixels(b).transpose(Image.FLIP_LEFT_RIGHT)) if i > len(f) // 2 else b for i, b in enumerate(f)]


def half_black(f, eps, c):
    def cut(image):
        a = np.array(image)
        a[a.shape[0] // 2:] = 0
        return Image.fromarray(a)
    return [jpeg(cut(pixels(b))) for b in f]


def grey_block(f, eps, c):
    """Lost packets: the lower half of 8 single frames is grey."""
    def cut(image):
        a = np.array(image)
        a[a.shape[0] // 2:] = 128
        return Image.fromarray(a)
    lost = set(range(5, len(f), max(1, len(f) // 8)))
    return [jpeg(cut(pixels(b))) if i in lost else b for i, b in enumerate(f)]


def every_third_frame(f, eps, c):
    return [f[i // 3 * 3] for i in range(len(f))]


NUMBERS = [lagging_dim, drift, swapped_states, mirrored, gain, overflow, held_actions, clipped_actions, late_border, decimal_slip, interleaved,
           reversed_stretch, zero_padding, unit_from_halfway, clock_gains, copied_dim, sentinel, shuffled_actions, added_sine, actions_of_previous]
FRAMES = [flicker, zoomed, blue_lost, poor_quality, mirrored_from_halfway, half_black, grey_block, every_third_frame]
DEFECTS = [(f.__name__, numbers(f), False) for f in NUMBERS] + [(f.__name__, frames(f), True) for f in FRAMES]


def findings(folder):
    out = subprocess.run([PROGRAM, "-q", "validate", str(folder), "--format", "json", "--fail-on", "never"], capture_output=True, text=True)
    if out.returncode:
        return [("FAILED " + out.stderr.strip(), "error", None)]
    return [(f["code"], f["severity"], f.get("episode")) for f in json.loads(out.stdout)["findings"]]


def main():
    found = planted = 0
    for name, (folder, n_episodes) in BASES.items():
        base = load(folder, n_episodes)
        write(SCRATCH / "clean", base, base[3])
        clean = findings(SCRATCH / "clean")
        print(f"{name}: unchanged has {sorted({(c, s) for c, s, _ in clean if s != 'info'})}", flush=True)
        for defect, plant, needs_camera in DEFECTS:
            if ONLY and defect not in ONLY or needs_camera and not base[2]:
                continue
            episodes = [{k: v.copy() for k, v in e.items()} for e in base[3]]
            plant(episodes, base[2])
            write(SCRATCH / "x", base, episodes)
            new = [f for f in findings(SCRATCH / "x") if f not in clean and f[2] in (None, EPISODE, EPISODE - 1, EPISODE + 1)]
            loud = sorted({f"{c}[{e}]" for c, s, e in new if s != "info"})
            quiet = sorted({f"{c}[{e}]" for c, s, e in new if s == "info"})
            planted += 1
            found += bool(loud)
            print(f"{'OK  ' if loud else 'note' if quiet else 'MISS'} {name:14} {defect:22} {' '.join(loud or quiet)}", flush=True)
    print(f"{found} of {planted}")


if __name__ == "__main__":
    main()
