"""Plants defects in a clean LeRobot v3 folder whose motion is not the self-test's, and asks gawm-data for them.

    python planted_defects.py GAWM_DATA SCRATCH_DIR [DEFECT...]

Ten episodes of an arm with six joints and a gripper that lag behind their commands, one camera, five sessions. One defect at
a time; a line per defect: OK (a warning or an error that the clean folder does not have), note, or MISS.
"""
import io, json, shutil, subprocess, sys
from pathlib import Path
import numpy as np, pyarrow as pa, pyarrow.parquet as pq
from PIL import Image
GD, W = sys.argv[1], Path(sys.argv[2])
FPS, NE = 25, 10
def make(seed=1):
    r = np.random.default_rng(seed); eps = []
    for e in range(NE):
        n = int(r.integers(140, 240)); t = np.arange(n) / FPS
        J = []
        for j in range(6):
            x = sum(r.uniform(.15, .5) * np.sin(2*np.pi*r.uniform(.08, .5)*t + r.uniform(0, 6)) for _ in range(3)) + .2*j
            J.append(x)
        J = np.stack(J, 1); g = .04 * (np.sin(2*np.pi*.15*t + r.uniform(0, 6)) > 0); 
        g = np.convolve(np.r_[np.full(4, g[0]), g], np.ones(5)/5, "valid")
        cmd = np.c_[J, g]; st = np.empty_like(cmd); st[0] = cmd[0]
        for i in range(1, n): st[i] = st[i-1] + .35 * (cmd[i-1] - st[i-1])
        st = st + r.normal(0, 4e-4, st.shape) * np.r_[np.ones(6), .01]
        fr = []
        for i in range(n):
            yy, xx = np.mgrid[0:32, 0:32]
            base = 90 + 60*np.sin(xx/5 + st[i, 0]*2) * np.cos(yy/6 + st[i, 1]*2)
            px = np.clip(np.stack([base, base*.8 + 10*st[i, 2], base*.6 + 30], -1) + r.normal(0, 2, (32, 32, 3)), 0, 255).astype(np.uint8)
            fr.append(px)
        eps.append(dict(s=st.astype(np.float32), a=cmd.astype(np.float32), f=fr, session=f"day{e//2}", split="train" if e < 8 else "val", task="stack the blue block on the plate", success=bool(e % 3)))
    return eps
NAMES = [f"joint_{i}" for i in range(6)] + ["gripper"]
def jpg(px):
    b = io.BytesIO(); Image.fromarray(px).save(b, "JPEG", quality=92); return b.getvalue()
def write(eps, d, info_mod=None, cols_mod=None, clock=None):
    shutil.rmtree(d, ignore_errors=True); (d/"meta/episodes/chunk-000").mkdir(parents=True); (d/"data/chunk-000").mkdir(parents=True)
    tasks = sorted({e["task"] for e in eps}); rows = {k: [] for k in ["timestamp","frame_index","episode_index","index","task_index","observation.state","action","observation.images.cam"]}; N = 0; ep = []
    for k, e in enumerate(eps):
        n = len(e["s"]); ts = e.get("ts", np.arange(n)/FPS)
        rows["timestamp"] += list(np.float32(ts)); rows["frame_index"] += list(range(n)); rows["episode_index"] += [k]*n; rows["index"] += list(range(N, N+n)); rows["task_index"] += [tasks.index(e["task"])]*n
        rows["observation.state"] += list(map(list, e["s"])); rows["action"] += list(map(list, e["a"])); rows["observation.images.cam"] += [dict(bytes=jpg(p), path=None) for p in e["f"]]
        ep.append(dict(episode_index=k, tasks=[e["task"]], length=n, dataset_from_index=N, dataset_to_index=N+n, success=e["success"], session=e["session"], split=e["split"], **{"data/chunk_index":0,"data/file_index":0,"meta/episodes/chunk_index":0,"meta/episodes/file_index":0})); N += n
    W7 = len(eps[0]["s"][0])
    sch = pa.schema([("timestamp", pa.float32())] + [(k, pa.int64()) for k in ["frame_index","episode_index","index","task_index"]] + [("observation.state", pa.list_(pa.float32())), ("action", pa.list_(pa.float32())), ("observation.images.cam", pa.struct([("bytes", pa.binary()), ("path", pa.string())]))])
    pq.write_table(pa.table({k: pa.array(v, sch.field(k).type) for k, v in rows.items()}, schema=sch), d/"data/chunk-000/file-000.parquet")
    pq.write_table(pa.Table.from_pylist(ep), d/"meta/episodes/chunk-000/file-000.parquet")
    import pandas as pd
    pd.DataFrame(dict(task_index=range(len(tasks))), index=pd.Index(tasks, name="task")).to_parquet(d/"meta/tasks.parquet")
    S = np.concatenate([e["s"] for e in eps]); A = np.concatenate([e["a"] for e in eps]); st = {}
    for nm, X in [("observation.state", S), ("action", A)]:
        st[nm] = dict(min=X.min(0).tolist(), max=X.max(0).tolist(), mean=X.mean(0, dtype=float).tolist(), std=X.std(0, dtype=float).tolist(), count=[len(X)])
    st["observation.images.cam"] = {k: [[[.4]]]*3 for k in ["min","max","mean","std"]} | dict(count=[100])
    (d/"meta/stats.json").write_text(json.dumps(st).replace("NaN", "0"))
    u = ["rad"]*6 + ["m"]
    info = dict(codebase_version="v3.0", robot_type="x", total_episodes=len(eps), total_frames=N, total_tasks=len(tasks), chunks_size=1000, data_files_size_in_mb=100, video_files_size_in_mb=200, fps=FPS, splits={"train": f"0:{len(eps)}"}, data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", video_path=None, features={**{"timestamp": dict(dtype="float32", shape=[1], names=None)}, **{k: dict(dtype="int64", shape=[1], names=None) for k in ["frame_index","episode_index","index","task_index"]}, "observation.state": dict(dtype="float32", shape=[W7], names=NAMES, units=u), "action": dict(dtype="float32", shape=[W7], names=NAMES, units=u), "observation.images.cam": dict(dtype="image", shape=[32,32,3], names=["height","width","channels"])})
    if info_mod: info_mod(info)
    (d/"meta/info.json").write_text(json.dumps(info))
def validate(d):
    p = subprocess.run([GD, "validate", str(d), "--format", "json", "--fail-on", "never"], capture_output=True, text=True)
    try: return json.loads(p.stdout)["findings"]
    except Exception: return [dict(code="OPEN", severity="error", episode=None, message=p.stderr)]
base = make()
def clone(): return [dict(e, s=e["s"].copy(), a=e["a"].copy(), f=list(e["f"])) for e in base]
D = {}
def d(fn): D[fn.__name__] = fn; return fn
@d
def permuted_all(E): 
    for e in E: e["a"][:, [1, 3]] = e["a"][:, [3, 1]]
@d
def permuted_one(E): E[4]["a"][:, [0, 2]] = E[4]["a"][:, [2, 0]]
@d
def action_late1_one(E): E[3]["a"] = np.r_[E[3]["a"][:1], E[3]["a"][:-1]]
@d
def action_late3_one(E): E[3]["a"] = np.r_[E[3]["a"][:3], E[3]["a"][:-3]]
@d
def action_early2_one(E): E[3]["a"] = np.r_[E[3]["a"][2:], E[3]["a"][-2:]]
@d
def degrees_all(E):
    for e in E: e["s"][:, :6] *= 57.2958; e["a"][:, :6] *= 57.2958
@d
def degrees_one(E): E[5]["s"][:, :6] *= 57.2958; E[5]["a"][:, :6] *= 57.2958
@d
def degrees_action(E):
    for e in E: e["a"][:, :6] *= 57.2958
@d
def frozen_cam(E): E[2]["f"][60:120] = [E[2]["f"][60]]*60
@d
def frozen_cam_noise(E):
    r = np.random.default_rng(0)
    for i in range(60, 120): E[2]["f"][i] = np.clip(E[2]["f"][60].astype(int) + r.integers(-1, 2, (32, 32, 3)), 0, 255).astype(np.uint8)
@d
def black_cam(E): E[7]["f"][30:60] = [np.zeros((32, 32, 3), np.uint8)]*30
@d
def cam_late6(E): E[6]["f"] = [E[6]["f"][0]]*6 + E[6]["f"][:-6]
@d
def session_both(E): E[8]["session"] = "day0"
@d
def nan_one(E): E[1]["s"][50, 2] = np.nan
@d
def inf_action(E): E[1]["a"][50, 2] = np.inf
@d
def stuck_joint(E): E[6]["s"][70:130, 1] = E[6]["s"][70, 1]
@d
def spike(E): E[0]["s"][88, 4] += .8
@d
def zero_drop(E): E[0]["s"][[33, 77, 101], 5] = 0
@d
def dup_episode(E):
    for k in ["s", "a", "f"]: E[9][k] = E[1][k]
@d
def near_dup(E):
    n = min(len(E[9]["s"]), len(E[1]["s"])); r = np.random.default_rng(3)
    E[9]["s"] = E[1]["s"] + r.normal(0, 1e-4, E[1]["s"].shape).astype(np.float32); E[9]["a"] = E[1]["a"].copy(); E[9]["f"] = [np.clip(p.astype(int)+1, 0, 255).astype(np.uint8) for p in E[1]["f"]]
@d
def deltas(E):
    for e in E: e["a"][:, :6] = np.diff(e["s"][:, :6], axis=0, append=e["s"][-1:, :6])
@d
def sign_flip(E): E[4]["a"][:, 2] *= -1
@d
def sign_flip_all(E):
    for e in E: e["a"][:, 2] *= -1
@d
def calib_offset(E): E[5]["s"][:, 3] += .4
@d
def saturated(E):
    for e in E: e["s"][:, 0] = np.clip(e["s"][:, 0], -.25, .25)
@d
def dropped_rows(E):
    k = list(range(60)) + list(range(75, len(E[3]["s"])))
    for x in ["s", "a"]: E[3][x] = E[3][x][k]
    E[3]["f"] = [E[3]["f"][i] for i in k]
@d
def noisy(E): E[2]["s"][:, 4] += np.random.default_rng(5).normal(0, .01, len(E[2]["s"])).astype(np.float32)
@d
def backward_ts(E): n = len(E[4]["s"]); ts = np.arange(n)/FPS; ts[50:] -= .5; E[4]["ts"] = ts
@d
def gap_ts(E): n = len(E[4]["s"]); ts = np.arange(n)/FPS; ts[50:] += .5; E[4]["ts"] = ts
@d
def action_other_episode(E): n = min(len(E[4]["s"]), len(E[5]["s"])); E[4]["a"][:n] = E[5]["a"][:n]
@d
def const_joint_one(E): E[7]["s"][:, 2] = .3
@d
def gripper_mm(E):
    for e in E: e["s"][:, 6] *= 1000
@d
def const_action(E):
    for e in E: e["a"][:, 5] = 0
@d
def empty_task(E):
    for e in E: e["task"] = ""
@d
def label_conflict(E):
    for k in ["s", "a", "f"]: E[4][k] = E[0][k]
    E[4]["success"] = not E[0]["success"]
@d
def time_doubled(E):
    for x in ["s", "a"]: E[6][x] = E[6][x][::2]
    E[6]["f"] = E[6]["f"][::2]
@d
def repeated_rows(E):
    k = np.repeat(np.arange(len(E[6]["s"])), 2)[:len(E[6]["s"])]
    for x in ["s", "a"]: E[6][x] = E[6][x][k]
    E[6]["f"] = [E[6]["f"][i] for i in k]
@d
def frozen_state_tail(E): E[3]["s"][-40:] = E[3]["s"][-40]
@d
def swapped_frames(E): f = E[5]["f"]; f[80:90], f[90:100] = f[90:100], f[80:90]
@d
def wrong_size(E): E[5]["f"][40] = np.zeros((16, 16, 3), np.uint8) + 90
@d
def quantised(E): E[1]["s"][:, 1] = np.round(E[1]["s"][:, 1] / .05) * .05
only = sys.argv[3:]
write(base, W/"clean"); c = validate(W/"clean"); print("CLEAN:", [(f["code"], f["severity"], f["episode"], f["message"][:90]) for f in c])
clean = {(f["code"], f["episode"]) for f in c}
hit = 0
for name, fn in D.items():
    if only and name not in only: continue
    E = clone(); fn(E); write(E, W/"x"); found = [f for f in validate(W/"x") if (f["code"], f["episode"]) not in clean]
    loud = [f for f in found if f["severity"] in ("warning", "error")]
    hit += bool(loud)
    s = sorted({(f["code"], f["episode"]) for f in loud}, key=str)
    print(f"{'OK  ' if loud else ('note' if found else 'MISS')} {name:22s} {s[:7]}{'...' if len(s) > 7 else ''} {'' if loud else sorted({f['code'] for f in found})}", flush=True)
print(hit, "of", len(D))
