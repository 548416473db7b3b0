"""Writes 1,000,000 rows x 32 dims as a LeRobot v3 folder, and the same numbers as flat columns beside it.

    python benchmark_rows.py DIR
"""
import json, sys, numpy as np, pyarrow as pa, pyarrow.parquet as pq
from pathlib import Path
import pandas as pd
d = Path(sys.argv[1]); 
for f in ["meta/episodes/chunk-000", "data/chunk-000"]: (d/f).mkdir(parents=True, exist_ok=True)
r = np.random.default_rng(0); NE, n, K, FPS = 1000, 1000, 16, 50
fields = [("timestamp", pa.float32())] + [(k, pa.int64()) for k in ["frame_index","episode_index","index","task_index"]] + [("observation.state", pa.list_(pa.float32())), ("action", pa.list_(pa.float32()))]
w = pq.ParquetWriter(d/"data/chunk-000/file-000.parquet", pa.schema(fields), compression="snappy")
flat = pq.ParquetWriter(d.parent/"flat.parquet", pa.schema([(f"d{i}", pa.float32()) for i in range(2*K)]), compression="snappy")
off = pa.array(np.arange(0, n*K+1, K, dtype=np.int32)); t = np.arange(n)/FPS; eps = []; tot = []
for e in range(NE):
    f = r.uniform(.05, .6, (3, K)); p = r.uniform(0, 6, (3, K)); a = r.uniform(.1, .5, (3, K))
    cmd = (a[:, None]*np.sin(2*np.pi*f[:, None]*t[None, :, None] + p[:, None])).sum(0)
    st = np.roll(cmd, 1, 0); st[0] = cmd[0]; st = (st + r.normal(0, 5e-4, st.shape)).astype(np.float32); cmd = cmd.astype(np.float32)
    i = np.arange(n)
    cols = [pa.array((i/FPS).astype(np.float32)), pa.array(i), pa.array(np.full(n, e)), pa.array(i + e*n), pa.array(np.zeros(n, int)), pa.ListArray.from_arrays(off, pa.array(st.ravel())), pa.ListArray.from_arrays(off, pa.array(cmd.ravel()))]
    w.write_table(pa.table(cols, schema=pa.schema(fields)))
    tot.append(np.c_[st, cmd]); eps.append(dict(episode_index=e, tasks=["move the arm along a smooth path"], length=n, dataset_from_index=e*n, dataset_to_index=(e+1)*n, success=True, **{"data/chunk_index":0,"data/file_index":0,"meta/episodes/chunk_index":0,"meta/episodes/file_index":0}))
w.close(); X = np.concatenate(tot); flat.write_table(pa.table([pa.array(X[:, i].copy()) for i in range(2*K)], schema=flat.schema), row_group_size=100000); flat.close()
pq.write_table(pa.Table.from_pylist(eps), d/"meta/episodes/chunk-000/file-000.parquet")
pd.DataFrame(dict(task_index=[0]), index=pd.Index(["move the arm along a smooth path"], name="task")).to_parquet(d/"meta/tasks.parquet")
st = lambda Y: dict(min=Y.min(0).tolist(), max=Y.max(0).tolist(), mean=Y.mean(0, dtype=float).tolist(), std=Y.std(0, dtype=float).tolist(), count=[len(Y)])
(d/"meta/stats.json").write_text(json.dumps({"observation.state": st(X[:, :K]), "action": st(X[:, K:])}))
nm = [f"j{i}" for i in range(K)]
feat = {"timestamp": dict(dtype="float32", shape=[1], names=None), **{k: dict(dtype="int64", shape=[1], names=None) for k in ["frame_index","episode_index","index","task_index"]}, "observation.state": dict(dtype="float32", shape=[K], names=nm), "action": dict(dtype="float32", shape=[K], names=nm)}
(d/"meta/info.json").write_text(json.dumps(dict(codebase_version="v3.0", robot_type="x", total_episodes=NE, total_frames=NE*n, total_tasks=1, chunks_size=1000, data_files_size_in_mb=100, video_files_size_in_mb=200, fps=FPS, splits={"train": f"0:{NE}"}, data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", video_path=None, features=feat)))
