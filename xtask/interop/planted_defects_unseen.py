"""Plants defects in data and of kinds that no rule of gawm-data was tuned on, and asks gawm-data for them.

    python planted_defects_unseen.py GAWM_DATA DATASETS SHARED SCRATCH_DIR [BASE|DEFECT...]

Needs gymnasium and stable-worldmodel beside the packages of requirements.txt: episodes of their environments, and recordings
of DATASETS (the scratch folder of healthy_datasets.py). Defects of all groups, each in one episode (the third) or, where it
says so, in a quarter of them or in the folder. OK: a warning or an error that the unchanged data do not have, which names the
episode or the whole dataset. Ends with what was found per base, per defect and in all, and the warnings on unchanged data.
"""
import io, json, shutil, sys, warnings
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, ImageFilter

from planted_defects_corpora import ACTION, DATASETS, EPISODE, ONLY, SCRATCH, SHARED, STATE, findings, jpeg, lively, load, other, pixels, write

warnings.filterwarnings("ignore")
CAMERA = "observation.images.camera"


def pendulum(o, rng, t):
    angle, energy = np.arctan2(o[1], o[0]), 0.5 * o[2] ** 2 + 10 * (o[0] - 1)
    return np.clip([(-0.5 * energy * np.sign(o[2]) if o[0] < 0.8 else -10 * angle - 2 * o[2]) + 0.3 * rng.normal()], -2, 2)


def mountain_car(o, rng, t):
    return np.clip([np.sign(o[1]) * 0.8 + 0.3 * rng.normal()], -1, 1)


def cart_pole(o, rng, t):
    return int(0.3 * o[0] + 0.5 * o[1] + 6 * o[2] + o[3] + 0.3 * rng.normal() > 0)


def acrobot(o, rng, t):
    return int(o[4] < 0) * 2 if rng.uniform() > 0.2 else int(rng.integers(3))


def simulate(name, policy, n_episodes, n_rows, fps, **options):
    env, rng, episodes = gym.make(name, **options), np.random.default_rng(7), []
    for k in range(n_episodes):
        o, _ = env.reset(seed=100 + k)
        states, actions = [], []
        for t in range(n_rows):
            a = policy(o, rng, t)
            states.append(np.ravel(o).astype(float))
            actions.append(np.ravel(a).astype(float))
            o, _, done, *_ = env.step(np.asarray(a, np.float32) if np.ndim(a) else a)
            if done:
                break
        episodes.append({STATE: np.array(states), ACTION: np.array(actions), "ts": np.arange(len(states)) / fps})
    return described(episodes, fps)


def push_t(n_episodes, n_rows, fps):
    """PushT of stable-worldmodel under its own weak policy of noisy way points."""
    import stable_worldmodel  # noqa: F401, registers the environment
    env, rng, episodes = gym.make("swm/PushT-v1", render_mode="rgb_array"), np.random.default_rng(3), []
    for k in range(n_episodes):
        o, info = env.reset(seed=k)
        states, actions, frames, goal = [], [], [], np.zeros(2)
        for t in range(n_rows):
            states.append(np.ravel(o["state"] if isinstance(o, dict) else o).astype(float))
            if t % 8 == 0:
                goal = rng.uniform(100, 400, 2)
            frames.append(jpeg(Image.fromarray(env.render()).resize((96, 96)), 95))
            actions.append(np.clip((goal - states[-1][:2]) / 100 + 0.1 * rng.normal(size=2), -1, 1))
            o, *_ = env.step(actions[-1].astype(np.float32))
        episodes.append({STATE: np.array(states), ACTION: np.array(actions), CAMERA: frames, "ts": np.arange(n_rows) / fps})
    info, vectors, _, _ = described(episodes, fps)
    info["features"][CAMERA] = dict(dtype="image", shape=[96, 96, 3], names=["height", "width", "channels"])
    return info, vectors, [CAMERA], episodes


def described(episodes, fps):
    features = {k: dict(dtype="float32", shape=[episodes[0][k].shape[1]], names=[f"{k[-1]}_{i}" for i in range(episodes[0][k].shape[1])])
                for k in (STATE, ACTION)}
    return dict(fps=fps, features=features), [STATE, ACTION], [], episodes


def cut(base, rows):
    """One long recording in episodes of `rows` rows."""
    info, vectors, cameras, (whole,) = base
    n = len(whole["ts"]) // rows
    return info, vectors, cameras, [{k: v[i * rows:(i + 1) * rows] for k, v in whole.items()} | {"ts": np.arange(rows) / info["fps"]} for i in range(n)]


def tail(base, first):
    return *base[:3], base[3][first:]


BASES = {
    "pendulum": lambda: simulate("Pendulum-v1", pendulum, 16, 160, 20),
    "mountain_car": lambda: simulate("MountainCarContinuous-v0", mountain_car, 12, 110, 30),
    "cart_pole": lambda: simulate("CartPole-v1", cart_pole, 20, 150, 50),
    "acrobot": lambda: simulate("Acrobot-v1", acrobot, 12, 120, 5),
    "push_t": lambda: push_t(10, 60, 10),
    "push_ball": lambda: cut(load(DATASETS / "d4rl_style_physical_0.hdf5/dataset", 1), 200),
    "isaac_arm": lambda: load(DATASETS / "isaaclab_indy7_annotated/dataset", 8),
    "maze_2": lambda: tail(load(DATASETS / "d4rl_style_maze2d-umaze-v1.hdf5/dataset", 117), 60),
    "cart_pendulum_2": lambda: tail(load(DATASETS / "cart_pendulum_demo.hdf5/dataset", 100), 70),
    "reachy": lambda: load(SHARED / "corpora/lerobot_v3_apple_storage", 3),
}


def one(change):
    return lambda eps, cameras: change(eps[min(EPISODE, len(eps) - 1)], eps)


def states(change):
    """`change(values, n)` of the liveliest dim of the state."""
    def plant(eps, cameras):
        e = eps[min(EPISODE, len(eps) - 1)]
        d = lively(e)
        e[STATE][:, d] = change(e[STATE][:, d].copy(), len(e["ts"]))
    return plant


def filtered(v, n):
    out = v.copy()
    for t in range(1, n):
        out[t] = out[t - 1] + 0.25 * (v[t] - out[t - 1])
    return out


def session(eps, cameras):
    for e in eps[:max(1, len(eps) // 4)]:
        e[STATE][:, lively(eps[0])] *= 0.5


def dropped_rows(e, eps):
    n, at = len(e["ts"]), len(e["ts"]) // 2
    for k, v in e.items():
        e[k] = v[:at] + v[at + 5:] if isinstance(v, list) else np.delete(v, np.s_[at:at + 5], 0)
    e["ts"] = np.arange(n - 5) * (e["ts"][1] - e["ts"][0])


def late_state(e, eps):
    e[STATE][3:] = e[STATE][:-3].copy()


def foreign_middle(e, eps):
    a = len(e["ts"]) // 3
    source = eps[0]
    n = min(20, len(source["ts"]) - a, len(e["ts"]) - a)
    for k in (STATE, ACTION):
        e[k][a:a + n] = source[k][a:a + n]


def cut_copy(e, eps):
    source = eps[0]
    for k in e:
        e[k] = source[k][5:] if isinstance(source[k], list) else source[k][5:].copy()
    e[STATE] = e[STATE] + 1e-3 * e[STATE].std(0) * np.random.default_rng(0).normal(size=e[STATE].shape)
    e["ts"] = np.arange(len(e[STATE])) * (eps[1]["ts"][1] - eps[1]["ts"][0])


def action_change(change):
    def plant(e, eps):
        e[ACTION] = change(e[ACTION], len(e["ts"]))
    return one(plant)


def clock(change):
    def plant(e, eps):
        e["ts"] = change(e["ts"].copy(), e["ts"][1] - e["ts"][0])
    return one(plant)


def put(values, at, value):
    values[at] = value
    return values


def images(change):
    def plant(e, eps):
        e[CAMERA] = change(list(e[CAMERA]), eps)
    return one(plant)


def each(change):
    return images(lambda f, eps: [jpeg(change(pixels(b)), 95) for b in f])


def shifted(image, by):
    return Image.fromarray(np.roll(np.array(image), by, 1))


def rows_table(change):
    """A change of the folder's data file."""
    def plant(folder):
        path = folder / "data/chunk-000/file-000.parquet"
        pq.write_table(change(pq.read_table(path)), path)
    return plant


def meta(change):
    def plant(folder):
        path = folder / "meta/info.json"
        info = json.loads(path.read_text())
        change(info)
        path.write_text(json.dumps(info))
    return plant


def replaced(table, name, change):
    values = table[name].to_pylist()
    change(values)
    return table.set_column(table.schema.get_field_index(name), table.schema.field(name), pa.array(values, table.schema.field(name).type))


VALUES = {
    "VALUE offset from half-way": states(lambda v, n: v + np.where(np.arange(n) > n // 2, 0.4 * np.ptp(v), 0)),
    "VALUE half as large": states(lambda v, n: 0.5 * v),
    "VALUE a third larger": states(lambda v, n: 1.35 * v),
    "VALUE in degrees": states(lambda v, n: 57.29578 * v),
    "VALUE in inches": states(lambda v, n: v / 0.0254),
    "VALUE negated from half-way": states(lambda v, n: np.where(np.arange(n) > n // 2, -v, v)),
    "VALUE offset by its range": states(lambda v, n: v + np.ptp(v)),
    "VALUE low-pass filtered": states(filtered),
    "VALUE two rows late": states(lambda v, n: np.r_[v[:1], v[:1], v[:-2]]),
    "VALUE every third sample held": states(lambda v, n: v[np.arange(n) // 3 * 3]),
    "VALUE coarse": states(lambda v, n: np.round(v / (np.ptp(v) / 12)) * np.ptp(v) / 12),
    "VALUE noise of a tenth": states(lambda v, n: v + 0.1 * np.ptp(v) * np.random.default_rng(1).normal(size=n)),
    "VALUE cut off at 80 %": states(lambda v, n: v.clip(None, np.quantile(v, 0.8))),
    "VALUE stuck for a fifth": states(lambda v, n: np.where((np.arange(n) > n // 2) & (np.arange(n) < n // 2 + n // 5), v[n // 2], v)),
    "VALUE one spike": states(lambda v, n: np.where(np.arange(n) == n // 3, v + 2 * np.ptp(v), v)),
    "VALUE three NaN": states(lambda v, n: np.where(np.isin(np.arange(n), [9, 10, 11]), np.nan, v)),
    "VALUE slow drift of a fifth": states(lambda v, n: v + np.linspace(0, 0.2 * np.ptp(v), n)),
    "VALUE scaled in a quarter of the episodes": session,
    "SEMANTIC actions two rows late": action_change(lambda a, n: np.vstack([a[:1], a[:1], a[:-2]])),
    "SEMANTIC actions three rows early": action_change(lambda a, n: np.vstack([a[3:], a[-1:], a[-1:], a[-1:]])),
    "SEMANTIC an action negated": action_change(lambda a, n: a * np.r_[-1.0, np.ones(a.shape[1] - 1)] if a.min() < 0 else 1 - a),
    "SEMANTIC actions half as large": action_change(lambda a, n: 0.5 * a),
    "SEMANTIC actions of zero": action_change(lambda a, n: 0 * a),
    "SEMANTIC states three rows late": one(late_state),
    "TIME five rows lost": one(dropped_rows),
    "TIME two rows at one time": clock(lambda ts, dt: put(ts, 20, ts[19])),
    "TIME backwards": clock(lambda ts, dt: put(ts, slice(20, None), ts[20:] - 5 * dt)),
    "TIME a gap of ten": clock(lambda ts, dt: put(ts, slice(20, None), ts[20:] + 10 * dt)),
    "TIME 2 % fast": clock(lambda ts, dt: 0.98 * ts),
    "TIME jitter": clock(lambda ts, dt: ts + 0.45 * dt * np.random.default_rng(0).uniform(-1, 1, len(ts))),
    "SPLIT a copy that was cut, with noise": one(cut_copy),
    "SPLIT rows of another episode": one(foreign_middle),
}
IMAGES = {
    "IMAGE eight frames late": images(lambda f, eps: f[:1] * 8 + f[:-8]),
    "IMAGE darker": each(lambda i: i.point(lambda v: v // 4)),
    "IMAGE blurred": each(lambda i: i.filter(ImageFilter.GaussianBlur(6))),
    "IMAGE camera moved": each(lambda i: shifted(i, 24)),
    "IMAGE colours exchanged": each(lambda i: Image.merge("RGB", i.split()[::-1])),
    "IMAGE negative": each(lambda i: i.point(lambda v: 255 - v)),
    "IMAGE frozen for ten rows": images(lambda f, eps: f[:20] + [f[20]] * 10 + f[30:]),
    "IMAGE of another episode": images(lambda f, eps: list(eps[0][CAMERA])[:len(f)] + f[len(eps[0][CAMERA]):]),
    "IMAGE cut off file": images(lambda f, eps: f[:15] + [f[15][: len(f[15]) // 2]] + f[16:]),
    "IMAGE not a picture": images(lambda f, eps: f[:15] + [b"GIF89a"] + f[16:]),
    "IMAGE another size": images(lambda f, eps: f[:15] + [jpeg(pixels(f[15]).resize((48, 48)))] + f[16:]),
    "IMAGE in reverse": images(lambda f, eps: f[::-1]),
}
FOLDER = {
    "STRUCT null in a row": rows_table(lambda t: replaced(t, ACTION, lambda v: v.__setitem__(30, None))),
    "STRUCT a short list": rows_table(lambda t: replaced(t, STATE, lambda v: v.__setitem__(30, v[30][:-1]))),
    "STRUCT index from 1": rows_table(lambda t: replaced(t, "index", lambda v: v.__setitem__(slice(None), [i + 1 for i in v]))),
    "STRUCT frame_index goes on": rows_table(lambda t: replaced(t, "frame_index", lambda v: v.__setitem__(slice(None), range(len(v))))),
    "STRUCT rows in another order": rows_table(lambda t: t.take(np.r_[np.arange(40, 60), np.arange(40), np.arange(60, t.num_rows)])),
    "STRUCT last rows missing": rows_table(lambda t: t.slice(0, t.num_rows - 7)),
    "STRUCT column missing": rows_table(lambda t: t.drop_columns([ACTION])),
    "STRUCT text for numbers": rows_table(lambda t: t.set_column(t.schema.get_field_index("timestamp"), "timestamp", pa.array([str(v) for v in t["timestamp"].to_pylist()]))),
    "STRUCT unknown task": rows_table(lambda t: replaced(t, "task_index", lambda v: v.__setitem__(30, 9))),
    "STRUCT shape too wide": meta(lambda i: i["features"][STATE].update(shape=[i["features"][STATE]["shape"][0] + 1])),
    "STRUCT fps of 0": meta(lambda i: i.update(fps=0)),
    "STRUCT path out of the folder": meta(lambda i: i.update(data_path="../data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet")),
    "SPLIT over the end": meta(lambda i: i.update(splits={"train": "0:2", "val": "2:999"})),
    "SPLIT overlapping": meta(lambda i: i.update(splits={"train": "0:3", "val": "2:3"})),
    "TIME twice the rate": meta(lambda i: i.update(fps=2 * i["fps"])),
}


def main():
    by_base, by_defect, alarms = Counter(), Counter(), 0
    planted_base, planted_defect = Counter(), Counter()
    chosen = [b for b in BASES if b in ONLY] or list(BASES)
    kinds = [o for o in ONLY if o not in BASES]
    for name in chosen:
        base = BASES[name]()
        target = min(EPISODE, len(base[3]) - 1)
        write(SCRATCH / "clean", base, base[3])
        clean = findings(SCRATCH / "clean")
        loud = Counter(c for c, s, _ in clean if s != "info" and c not in ("STRUCT-015", "STRUCT-020"))
        alarms += sum(loud.values())
        print(f"{name}: {len(base[3])} episodes, {sum(len(e['ts']) for e in base[3])} rows, unchanged: {dict(loud)}", flush=True)
        for defect, plant in (VALUES | (IMAGES if base[2] else {}) | FOLDER).items():
            if kinds and not any(k in defect for k in kinds):
                continue
            episodes = [{k: v.copy() for k, v in e.items()} for e in base[3]]
            if defect not in FOLDER:
                plant(episodes, base[2])
            write(SCRATCH / "x", base, episodes)
            if defect in FOLDER:
                plant(SCRATCH / "x")
            allowed = range(max(1, len(episodes) // 4)) if plant is session else (None, target, target - 1, target + 1, 0)
            new = [f for f in findings(SCRATCH / "x") if f not in clean and (defect in FOLDER or f[2] in allowed)]
            loud = sorted({f"{c}[{e}]" for c, s, e in new if s != "info"})
            quiet = sorted({f"{c}[{e}]" for c, s, e in new if s == "info"})
            planted_base[name] += 1
            planted_defect[defect] += 1
            by_base[name] += bool(loud)
            by_defect[defect] += bool(loud)
            print(f"{'OK  ' if loud else 'note' if quiet else 'MISS'} {name:16} {defect:42} {' '.join((loud or quiet)[:6])}", flush=True)
    print("\n".join(f"{by_base[b]:3} of {planted_base[b]:3}  {b}" for b in planted_base))
    print("\n".join(f"{by_defect[d]:3} of {planted_defect[d]:3}  {d}" for d in planted_defect))
    groups = Counter(), Counter()
    for d in planted_defect:
        groups[0][d.split()[0]] += by_defect[d]
        groups[1][d.split()[0]] += planted_defect[d]
    print("; ".join(f"{g} {groups[0][g]} of {groups[1][g]}" for g in groups[1]))
    print(f"{sum(by_base.values())} of {sum(planted_base.values())}, {alarms} warnings on {len(chosen)} unchanged datasets")
    shutil.rmtree(SCRATCH / "x", ignore_errors=True)


main()
