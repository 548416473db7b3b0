"""Computes the statistics of a small dataset with numpy, for `crates/gawm-dataset/tests/statistics_oracle.rs`.

    python statistics_oracle.py > crates/gawm-dataset/tests/golden/statistics.json

The rows come from a linear congruential generator that the test repeats; nothing here is taken from gawm.
"""

import json
import sys

import numpy as np

FPS = 20
LENGTHS = [150, 73, 400]
LAGS = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128]
state = 12345


def uniform():
    """The next number in [0, 1)."""
    global state
    state = (state * 1664525 + 1013904223) % 2**32
    return state / 2**32


def episode(n):
    """An angle that turns, a walk, and a signal that rests half of the time."""
    rows, angle, walk, held = [], uniform(), uniform(), 0.0
    for t in range(n):
        angle += (uniform() - 0.375) * 0.5
        walk += (uniform() - 0.5) * 0.125
        fresh = uniform()
        if t % 16 < 8:
            held = fresh
        rows.append([angle - 6.25 * np.floor((angle + 3.125) / 6.25), walk, held])
    return np.array(rows)


def wrapped(step):
    return step - 2 * np.pi * np.round(step / (2 * np.pi))


def summary(values):
    out = dict(count=len(values), mean=values.mean(), std=values.std(), min=values.min(), max=values.max())
    for name, q in dict(q01=0.01, q10=0.1, q50=0.5, q90=0.9, q99=0.99).items():
        out[name] = np.quantile(values, q)
    return out


def motion(parts, is_angle):
    """Over several episodes: nothing crosses a border between them."""
    steps = [wrapped(np.diff(p)) if is_angle else np.diff(p) for p in parts]
    speed = np.concatenate([np.abs(s) for s in steps])
    jerk = np.concatenate([np.abs(s[2:] - 2 * s[1:-1] + s[:-2]) for s in steps])
    idle = sum(int((np.abs(s) <= 0.02 * np.abs(s).mean()).sum()) for s in steps)
    last, rho, secs = 0, 1.0, None
    parts = [np.unwrap(p) if is_angle else p for p in parts]
    for lag in LAGS:
        centred = [p - p.mean() for p in parts if len(p) > lag]
        top = sum(float((c[:-lag] * c[lag:]).sum()) for c in centred)
        bottom = sum(float(0.5 * (c[:-lag] ** 2 + c[lag:] ** 2).sum()) for c in centred)
        here = top / bottom
        if here < np.exp(-1):
            secs = (last + (lag - last) * (rho - np.exp(-1)) / (rho - here)) / FPS
            break
        last, rho = lag, here
    return dict(mean_speed=speed.mean() * FPS, max_speed=speed.max() * FPS, mean_jerk=jerk.mean() * FPS**3,
                idle_share=idle / len(speed), autocorrelation_secs=secs)


def measured(parts):
    dims = []
    for dim in range(3):
        values = [p[:, dim] for p in parts]
        entry = dict(summary=summary(np.concatenate(values)), motion=motion(values, dim == 0))
        if dim == 0:
            mean = np.exp(1j * np.concatenate(values)).mean()
            entry["circular"] = dict(mean_direction_rad=float(np.angle(mean)), resultant_length=float(abs(mean)))
        dims.append(entry)
    return dims


episodes = [episode(n) for n in LENGTHS]
encoded = [np.stack([np.sin(p[:, 0]), np.cos(p[:, 0]), p[:, 1], p[:, 2]], axis=1).astype(np.float32) for p in episodes]
whole = np.concatenate(encoded).astype(np.float64)
answer = dict(
    made_by=f"xtask/interop/statistics_oracle.py, numpy {np.__version__}",
    fps=FPS, lengths=LENGTHS, total=measured(episodes), episodes=[measured([p]) for p in episodes],
    encoded=[summary(whole[:, dim]) for dim in range(4)],
)
json.dump(answer, sys.stdout, indent=1, default=float)
print()
