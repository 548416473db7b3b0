"""Reads the event files of a run with the real tensorboard and compares every scalar with metrics.jsonl.

Usage: check_tensorboard.py RUN
"""

import json
import pathlib
import sys

import tensorboard
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def close(a, b):
    return abs(a - b) <= 1e-6 * (1 + abs(b))  # event files hold f32


def scalars(run, curves):
    accumulator = EventAccumulator(str(run / "tensorboard" / curves), size_guidance={"scalars": 0, "tensors": 0})
    accumulator.Reload()
    found = {}
    for tag in accumulator.Tags()["scalars"]:
        for event in accumulator.Scalars(tag):
            found[tag, event.step] = event.value
    return accumulator, found


def main():
    run = pathlib.Path(sys.argv[1])
    accumulator, model = scalars(run, "model")
    _, constant = scalars(run, "constant")
    _, identity = scalars(run, "identity")
    records = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    compared = 0
    for record in records:
        step = record["step"]
        prefix = record["kind"]
        for term in record["terms"]:
            tag = f"{prefix}/{term['term']}"
            assert close(model[tag, step], term["value"]), (tag, step)
            compared += 1
            baseline = term.get("baseline")
            if baseline:
                curve = identity if baseline["name"] == "identity" else constant
                assert close(curve[tag, step], baseline["value"]), (tag, step, baseline)
                compared += 1
        names = {"train": [("total", "total"), ("rate", "rate"), ("gradient norm", "gradient_norm")],
                 "validation": [("skill", "skill"), ("effective rank", "effective_rank"), ("score", "score")]}
        for tag, field in names[prefix]:
            assert close(model[f"{prefix}/{tag}", step], record[field]), (tag, step)
            compared += 1
    steps = {(record["kind"], record["step"]) for record in records}
    foreign = {(tag, step) for tag, step in model if tag.split("/")[0] in ("train", "validation")
               and (tag.split("/")[0], step) not in steps}
    assert not foreign, f"scalars that metrics.jsonl does not have: {sorted(foreign)[:5]}"
    texts = accumulator.Tags()["tensors"]
    assert "config" in texts, texts
    config = accumulator.Tensors("config")[0].tensor_proto.string_val[0].decode()
    assert "[train]" in config
    print(f"tensorboard {tensorboard.__version__}: {len(records)} records, {compared} scalars equal to metrics.jsonl,")
    print(f"{len(constant) + len(identity)} points of baselines in runs of their own, the configuration as a text.")


main()
