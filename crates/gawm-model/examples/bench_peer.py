"""PyTorch peer of bench_step.rs: the same model from published modules, the same batch sizes, the same JSON lines.

usage: bench_peer.py {step,encode,plan} [--preset tiny-14|nano] [--clips 8: iterations of a plan] [--repeats 3] [--threads 2] [--compile]
needs: stable-worldmodel==0.1.1, torch, transformers

Every repeat is timed; a line has the smallest wall time and the smallest CPU time (user and system, all threads) of a repeat.
"""
import argparse
import json
import resource
import time

import torch
import torch.nn.functional as F
from stable_worldmodel.wm.lewm import LeWM
from stable_worldmodel.wm.lewm.module import MLP, Embedder
from stable_worldmodel.wm.lewm.module import Predictor as ARPredictor
from torch import nn
from transformers import ViTConfig, ViTModel

# image, patch, encoder (width, depth, heads), predictor (depth, heads, head width, mlp), projector, G, H
PRESETS = {
    "tiny-14": (224, 14, (192, 12, 3), (6, 16, 64, 2048), 2048, 256, 512),
    "nano": (64, 8, (64, 4, 2), (2, 4, 16, 256), 256, 128, 128),
}
ACTION, STATE = 10, 6


def build(preset):
    image, patch, (width, depth, heads), (p_depth, p_heads, p_head, p_mlp), proj, g, h = PRESETS[preset]
    config = ViTConfig(hidden_size=width, num_hidden_layers=depth, num_attention_heads=heads,
                       intermediate_size=4 * width, image_size=image, patch_size=patch, layer_norm_eps=1e-12)
    m = LeWM(
        encoder=ViTModel(config, add_pooling_layer=False),
        predictor=ARPredictor(num_frames=3, input_dim=width, hidden_dim=width, output_dim=width, depth=p_depth,
                              heads=p_heads, mlp_dim=p_mlp, dim_head=p_head, dropout=0.1, emb_dropout=0.0),
        action_encoder=Embedder(input_dim=ACTION, emb_dim=width),
        projector=MLP(input_dim=width, output_dim=width, hidden_dim=proj, norm_fn=nn.BatchNorm1d),
        pred_proj=MLP(input_dim=width, output_dim=width, hidden_dim=proj, norm_fn=nn.BatchNorm1d),
    )
    m.state_probe = nn.Sequential(nn.Linear(2 * width, g), nn.LayerNorm(g), nn.GELU(), nn.Linear(g, STATE))
    m.idm_head = MLP(input_dim=2 * width, output_dim=ACTION, hidden_dim=h, norm_fn=nn.LayerNorm)
    return m


def loss(m, pixels, action, state):
    b, t = pixels.shape[:2]
    out = m.encode({"pixels": pixels, "action": action})
    z, c = out["emb"], out["act_emb"]
    prediction = (m.predict(z[:, :3], c[:, :3]) - z[:, 1:]).pow(2).mean()
    previous = torch.cat([z[:, :1], z[:, :-1]], 1)
    states = (m.state_probe(torch.cat([previous, z], -1)) - state).pow(2).mean()
    pair = torch.cat([z[:, :-1], z[:, 1:]], -1).reshape(b * (t - 1), -1)
    actions = F.mse_loss(m.idm_head(pair).view(b, t - 1, -1), action[:, : t - 1])
    return prediction + states + actions


def measure(repeats, work):
    work()
    walls, cpus = [], []
    for _ in range(repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return {"wall_s": round(min(walls), 4), "cpu_s": round(min(cpus), 4)}


def plan(m, size, samples, iterations, elites=30, horizon=5):
    frame, goal = torch.randn(1, 1, 1, 3, size, size), torch.randn(1, 1, 3, size, size)
    with torch.inference_mode():
        goal = m.encode({"pixels": goal})["emb"][0, -1]
        info = {"pixels": frame.expand(1, samples, 1, 3, size, size)}
        mean, sigma = torch.zeros(horizon, ACTION), torch.ones(horizon, ACTION)
        for _ in range(iterations):
            x = torch.randn(1, samples, horizon, ACTION) * sigma + mean
            x[:, 0] = mean
            info = m.rollout(info, x)
            cost = (info["predicted_emb"][0, :, -1] - goal).pow(2).sum(-1)
            best = x[0, torch.topk(cost, elites, largest=False).indices]
            mean, sigma = best.mean(0), best.std(0)


def main():
    p = argparse.ArgumentParser()
    p.add_argument("mode", choices=["step", "encode", "plan"])
    p.add_argument("--preset", default="tiny-14", choices=sorted(PRESETS))
    p.add_argument("--clips", type=int, default=8)
    p.add_argument("--repeats", type=int, default=3)
    p.add_argument("--threads", type=int, default=2)
    p.add_argument("--samples", type=int, default=300)
    p.add_argument("--compile", action="store_true")
    a = p.parse_args()
    torch.set_num_threads(a.threads)
    torch.manual_seed(0)
    m, size = build(a.preset), PRESETS[a.preset][0]
    frames = torch.randn(a.clips, 4, 3, size, size)
    if a.mode == "step":
        m.train()
        optimizer = torch.optim.AdamW(m.parameters(), lr=5e-5, weight_decay=1e-3)
        objective = torch.compile(loss) if a.compile else loss
        action, state = torch.randn(a.clips, 4, ACTION), torch.randn(a.clips, 4, STATE)

        def work():
            optimizer.zero_grad()
            objective(m, frames, action, state).backward()
            nn.utils.clip_grad_norm_(m.parameters(), 1.0)
            optimizer.step()
    elif a.mode == "encode":
        m.eval()
        encode = torch.compile(lambda x: m.encode({"pixels": x})["emb"]) if a.compile else (
            lambda x: m.encode({"pixels": x})["emb"])

        def work():
            with torch.inference_mode():
                encode(frames)
    else:
        m.eval()
        if a.compile:
            m.predict = torch.compile(m.predict, dynamic=False)

        def work():
            plan(m, size, a.samples, a.clips)
    line = {"who": "torch-compile" if a.compile else "torch", "mode": a.mode, "preset": a.preset, "clips": a.clips,
            "threads": a.threads} | measure(a.repeats, work)
    line["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps(line), flush=True)


main()
