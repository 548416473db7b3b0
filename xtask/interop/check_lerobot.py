"""Opens a gawm dataset with the published `lerobot` and compares what it hands out with the Parquet files themselves.

    python check_lerobot.py DATASET_DIR

Prints one line per check; exits 0 when all hold. Offline: nothing is fetched, nothing is written into the dataset.
"""

import io
import json
import os
import random
import sys
import tempfile
from pathlib import Path

SCRATCH = tempfile.mkdtemp(prefix="gawm_interop_")
for key in ("HF_HOME", "HF_LEROBOT_HOME", "HF_DATASETS_CACHE"):
    os.environ[key] = os.path.join(SCRATCH, key.lower())
for key in ("HF_HUB_OFFLINE", "HF_DATASETS_OFFLINE", "HF_DATASETS_DISABLE_PROGRESS_BARS"):
    os.environ[key] = "1"

import numpy as np  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402
from lerobot.datasets.lerobot_dataset import LeRobotDataset  # noqa: E402
from PIL import Image  # noqa: E402

root = Path(sys.argv[1])
info = json.loads((root / "meta/info.json").read_text())
features, fps = info["features"], info["fps"]
columns = list(features)
tables = [pq.ParquetFile(path) for path in sorted((root / "data").glob("*/*.parquet"))]
rows = [(table, group, row) for table in tables for group in range(table.num_row_groups)
        for row in range(table.metadata.row_group(group).num_rows)]
tasks = pq.read_table(root / "meta/tasks.parquet").to_pydict()
episodes = pq.read_table(root / "meta/episodes").to_pydict()
failures = 0


def raw(index):
    """Returns row `index` as the files hold it."""
    table, group, row = rows[index]
    return table.read_row_group(group).slice(row, 1).to_pylist()[0]


def pixels(cell):
    """Returns an image cell as lerobot should: float32 [C, H, W]."""
    array = np.asarray(Image.open(io.BytesIO(cell["bytes"])))
    array = array[..., None] if array.ndim == 2 else array
    return array.transpose(2, 0, 1).astype(np.float32) / (255.0 if array.dtype == np.uint8 else 1.0)


def same(got, want, feature):
    """Raises unless a tensor equals what the file holds."""
    if feature["dtype"] == "string":
        assert got == want, f"{got!r} != {want!r}"
        return
    want = pixels(want) if feature["dtype"] == "image" else np.asarray(want, dtype=got.numpy().dtype)
    np.testing.assert_array_equal(got.numpy().reshape(want.shape), want)


def check(name, body):
    """Runs one check and prints its outcome."""
    global failures
    try:
        print(f"ok    {name}: {body()}")
    except Exception as error:  # a failed check is a line, the others still run
        failures += 1
        print(f"FAIL  {name}: {type(error).__name__}: {str(error)[:500]}")


def axes(feature):
    """Returns the positions of height and width in the declared shape."""
    names = feature.get("names") or ["height", "width", "channels"]
    return names.index("height"), names.index("width")


def counts():
    dataset = LeRobotDataset("local/gawm", root=str(root), video_backend="pyav")
    assert len(dataset) == len(rows) == info["total_frames"]
    assert dataset.num_episodes == info["total_episodes"] == len(episodes["episode_index"])
    return f"{dataset.num_episodes} episodes, {len(dataset)} frames at {dataset.fps} fps"


def frames():
    dataset = LeRobotDataset("local/gawm", root=str(root), video_backend="pyav")
    picked = {0, len(rows) - 1}
    for start, end in zip(episodes["dataset_from_index"], episodes["dataset_to_index"]):
        picked |= {start, end - 1, random.Random(0).randrange(start, end)}
    for index in sorted(picked):
        item, want = dataset[index], raw(index)
        for column in columns:
            if features[column]["dtype"] == "video":
                height, width = (features[column]["shape"][i] for i in axes(features[column]))
                assert tuple(item[column].shape) == (3, height, width), f"{column}: {tuple(item[column].shape)}"
            else:
                same(item[column], want[column], features[column])
        assert item["task"] == tasks["task"][want["task_index"]], f"task {item['task']!r}"
    return f"{len(picked)} frames, every column and task string equal to the files"


def boundaries():
    keys = [key for key in ("action", "observation.state") if key in features]
    keys += [key for key in columns if features[key]["dtype"] == "image"][:1]
    steps = {key: [-2 / fps, 0.0, 3 / fps] for key in keys}
    dataset = LeRobotDataset("local/gawm", root=str(root), video_backend="pyav", delta_timestamps=steps)
    looked = 0
    for start, end in zip(episodes["dataset_from_index"], episodes["dataset_to_index"]):
        for index in {start, end - 1}:
            item = dataset[index]
            for key in keys:
                for slot, step in enumerate((-2, 0, 3)):
                    outside = not start <= index + step < end
                    assert bool(item[f"{key}_is_pad"][slot]) == outside, f"padding of {key} at {index}{step:+d}"
                    clamped = min(max(index + step, start), end - 1)
                    same(item[key][slot], raw(clamped)[key], features[key])
                    looked += 1
    return f"{looked} shifted samples over episode boundaries equal, padding flags right"


def one_episode():
    last = len(episodes["episode_index"]) - 1
    dataset = LeRobotDataset("local/gawm", root=str(root), video_backend="pyav", episodes=[last])
    assert len(dataset) == episodes["length"][last]
    same(dataset[0]["index"], episodes["dataset_from_index"][last], features["index"])
    return f"episodes=[{last}] gives its {len(dataset)} frames"


def loader():
    import torch

    dataset = LeRobotDataset("local/gawm", root=str(root), video_backend="pyav")
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=min(8, len(dataset)), num_workers=2)))
    return f"DataLoader with 2 workers, batch of {len(batch['index'])}"


import lerobot  # noqa: E402

label = "/".join(part for part in root.resolve().parts[-3:] if part not in ("target", "interop-lerobot"))
print(f"lerobot {lerobot.__version__} on {label}")
for name, body in [("counts", counts), ("frames", frames), ("delta_timestamps", boundaries), ("episodes", one_episode), ("loader", loader)]:
    check(name, body)
sys.exit(1 if failures else 0)
