"""Counts what gawm-data validate says of healthy data: a Markdown table for docs/validation.md.

    python healthy_datasets.py PROGRAMS SHARED SCRATCH_DIR [NAME...]

PROGRAMS is the folder of gawm-data, gawm-ingest and gawm-sim, SHARED that of the corpora. Logs are ingested with the contract
that `gawm-ingest suggest` writes, unedited, or with a pipeline of this repository where one is named. Findings of level
warning and above are printed per dataset and code; TRUE lists those that are true of the data, the others are false alarms.
"""
import json, subprocess, sys
from collections import Counter
from pathlib import Path

PROGRAMS, SHARED, SCRATCH = (Path(a).resolve() for a in sys.argv[1:4])
ONLY = sys.argv[4:]
CORPORA = SHARED / "corpora"
PIPELINES = Path(__file__).resolve().parents[2] / "pipelines"

# name: (logs, pipeline or None for the suggested contract)
LOGS = {
    "cell/fleet": (["cell/fleet/*.mcap"], None),
    "cell/cell_mixed_zstd.mcap": (["cell/cell_mixed_zstd.mcap"], None),
    "cell/cell_split": (["cell/cell_split"], None),
    "cell/cell_no_action.mcap": (["cell/cell_no_action.mcap"], None),
    "generated/arm_ros2_zstd.mcap": (["generated/arm_ros2_zstd.mcap"], None),
    "generated/arm_ros2_unchunked.mcap": (["generated/arm_ros2_unchunked.mcap"], None),
    "generated/arm_json_lz4.mcap": (["generated/arm_json_lz4.mcap"], None),
    "generated/arm_protobuf.mcap": (["generated/arm_protobuf.mcap"], None),
    "generated/arm_rosbags": (["generated/arm_rosbags"], None),
    "generated/base_short.mcap": (["generated/base_short.mcap"], None),
    "cart_pole/out_of_bounds.mcap": (["cart_pole/out_of_bounds.mcap"], None),
    "mcap_explorer/demo.mcap": (["mcap_explorer/demo.mcap"], None),
    "rerun/rosbag2_2025_09_10": (["rerun/rosbag2_2025_09_10-13_03_56_0.mcap"], None),
    "isaaclab_indy7/annotated": (["isaaclab_indy7/annotated_dataset.hdf5"], None),
    "isaaclab_indy7/generated": (["isaaclab_indy7/generated_dataset_small.hdf5"], None),
    "cart_pendulum/demo.hdf5": (["cart_pendulum/demo.hdf5"], None),
    "arm7dof/scripted_demos.hdf5": (["arm7dof/scripted_demos.hdf5"], None),
    "d4rl_style/physical_0.hdf5": (["d4rl_style/physical_0.hdf5"], None),
    "d4rl_style/maze2d-umaze-v1.hdf5": (["d4rl_style/maze2d-umaze-v1.hdf5"], None),
    "mj_lift_npz": (["mj_lift_npz"], None),
    "g1_motion_npz": (["g1_motion_npz/motion.npz"], None),
    "swm_h5/tworoom.h5": (["swm_h5/tworoom.h5"], "tworoom-h5-ingest.toml"),
    "swm_h5/pusht.h5": (["swm_h5/pusht.h5"], "pusht-ingest.toml"),
    "swm_h5/reacher.h5": (["swm_h5/reacher.h5"], "reacher-ingest.toml"),
    "swm_h5/cube.h5": (["swm_h5/cube.h5"], "cube-ingest.toml"),
}
FOLDERS = ["lerobot_v2_gr1_picknplace", "lerobot_v3_apple_storage"]
# What is true of the data, by dataset and code, and why.
NO_TASK = {"SEMANTIC-006": "no task text"}
SHORT = {"SEMANTIC-013": "episodes of 14 to 28 rows hold few windows of 16"}
PART = {"IMAGE-011": "a feature without files", "SPLIT-004": "`info.json` of the whole dataset beside a part of it"}
# Beginning of a dataset's name: what is true of it.
TRUE = {
    "cell/": SHORT | {"VALUE-009": "quaternions change their sign"},
    "rerun/": SHORT,
    "isaaclab_indy7/": NO_TASK, "cart_pendulum/": NO_TASK, "arm7dof/": NO_TASK, "d4rl_style/": NO_TASK, "mj_lift_npz": NO_TASK,
    "g1_motion_npz": NO_TASK, "swm_h5/": NO_TASK,
    "lerobot_v2_gr1_picknplace": PART,
    "lerobot_v3_apple_storage": PART | {"STRUCT-013": "`info.json` of the whole dataset beside a part of it"},
}


def run(*command):
    return subprocess.run([str(c) for c in command], capture_output=True, text=True)


def ingest(name, logs, pipeline):
    out = SCRATCH / name.replace("/", "_")
    dataset = out / "dataset"
    if (dataset / "meta/info.json").is_file():
        return dataset
    out.mkdir(parents=True, exist_ok=True)
    files = [f for pattern in logs for f in sorted(CORPORA.glob(pattern))]
    contract = out / "contract.toml"
    if pipeline:
        contract = PIPELINES / pipeline
    else:
        suggested = run(PROGRAMS / "gawm-ingest", "suggest", *files)
        contract.write_text(suggested.stdout)
        if suggested.returncode not in (0, 3):
            return f"suggest: exit {suggested.returncode}: {suggested.stderr.strip().splitlines()[:1]}"
    done = run(PROGRAMS / "gawm-ingest", "run", "--config", contract, "--out", dataset, *files)
    if done.returncode not in (0, 3):
        return f"run: exit {done.returncode}: {done.stderr.strip()[:160]}"
    return dataset


def simulated():
    out = SCRATCH / "two_room"
    if not (out / "dataset/meta/info.json").is_file():
        run(PROGRAMS / "gawm-sim", "collect", "--env", "two-room", "--episodes", 340, "--seed", 20, "--out", out / "logs")
        run(PROGRAMS / "gawm-ingest", "run", "--config", PIPELINES / "quickstart.toml", "--out", out / "dataset", out / "logs")
    return out / "dataset"


def main():
    datasets = {name: (lambda n=name, v=value: ingest(n, *v)) for name, value in LOGS.items()}
    datasets |= {name: (lambda n=name: CORPORA / n) for name in FOLDERS}
    datasets["gawm-sim collect --env two-room"] = simulated
    rows, total = [], 0
    for name, make in datasets.items():
        if ONLY and not any(o in name for o in ONLY):
            continue
        dataset = make()
        if isinstance(dataset, str):
            rows.append(f"| `{name}` | not ingested: {dataset} | | |")
            print(rows[-1], file=sys.stderr)
            continue
        done = run(PROGRAMS / "gawm-data", "validate", dataset, "--format", "json", "--fail-on", "never")
        try:
            report = json.loads(done.stdout)
        except json.JSONDecodeError:
            rows.append(f"| `{name}` | not read: {done.stderr[:200]} | | |")
            continue
        loud = [f for f in report["findings"] if f["severity"] in ("warning", "error")]
        known = next((texts for start, texts in TRUE.items() if name.startswith(start)), {})
        false = [f for f in loud if f["code"] not in known]
        total += len(false)
        texts = {f["code"]: known[f["code"]] for f in loud if f["code"] in known}
        said = "; ".join(f"{code}: {text}" for code, text in sorted(texts.items()))
        wrong = ", ".join(f"{code} x {n}" for code, n in sorted(Counter(f["code"] for f in false).items()))
        n_info = report["counts"]["info"]
        rows.append(f"| `{name}` | {report['episodes']}, {report['rows']:,} | {said} | {len(false)}{': ' + wrong if wrong else ''} | {n_info} |")
        for f in false:
            print(name, f["code"], f["severity"], f["episode"], f["rows"], f["feature"], f["dim"], f["message"], sep=" | ", file=sys.stderr)
    print("| dataset | episodes, rows | true findings | false alarms | notes |\n| --- | --- | --- | --- | --- |")
    print("\n".join(rows))
    print(f"\n{total} false alarms", file=sys.stderr)


main()
