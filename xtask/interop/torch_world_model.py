"""The PyTorch side of `xtask interop torch`.

  torch_world_model.py make FOLDER    a published model with random weights: its files, inputs and answers
  torch_world_model.py check FOLDER   loads what we exported, compares weights, embeddings and rollouts, prints JSON
"""
import json, os, sys
import torch, torch.nn as nn
from safetensors.torch import load_file, save_file

here = os.path.dirname(os.path.abspath(__file__))
peer = os.path.join(here, "..", "..", "fixtures", "golden", "torch_peer.py")
tp = {}
exec(compile(open(peer).read().replace("\nmain()\n", "\n"), peer, "exec"), tp)
SIZE, PATCH, ACT, STATE, DEPTH, SAMPLES, HORIZON = 56, 14, 10, 6, 3, 8, 5


def build():
    m = tp["build"](SIZE, PATCH, ACT, STATE, DEPTH)
    return m.eval()


def answers(m, inputs):
    with torch.no_grad():
        px = inputs["frames"]
        emb = m.encode({"pixels": px})["emb"]
        out = {"emb": emb}
        for h in (1, 3):
            info = {"pixels": px[:1, :h].unsqueeze(1).expand(1, SAMPLES, h, 3, SIZE, SIZE)}
            ro = m.rollout(info, inputs["candidates"].unsqueeze(0))["predicted_emb"]
            out[f"rollout_{h}"] = ro[0, :, h:].contiguous()
    return {k: v.contiguous() for k, v in out.items()}


def old_key(k):
    if not k.startswith("encoder.layers."):
        return k
    _, _, n, part = k.split(".", 3)
    for new, old in (("attention.q_proj.", "attention.attention.query."), ("attention.k_proj.", "attention.attention.key."),
                     ("attention.v_proj.", "attention.attention.value."), ("attention.o_proj.", "attention.output.dense."),
                     ("mlp.fc1.", "intermediate.dense."), ("mlp.fc2.", "output.dense.")):
        part = part.replace(new, old)
    return f"encoder.encoder.layer.{n}.{part}"


def make(folder):
    torch.manual_seed(11)
    m = build()
    for k, v in m.named_parameters():
        if "adaLN" in k:
            v.data.add_(0.05 * torch.randn(v.shape))
    for k, v in m.named_buffers():
        if "running_mean" in k: v.copy_(0.1 * torch.randn(v.shape))
        if "running_var" in k: v.copy_(0.5 + torch.rand(v.shape))
        if "num_batches" in k: v.fill_(7)
    inputs = {"frames": torch.randn(2, 4, 3, SIZE, SIZE), "candidates": torch.randn(SAMPLES, HORIZON, ACT)}
    state = {k: v.detach().clone() for k, v in m.state_dict().items()}
    torch.save(m.state_dict(), f"{folder}/weights.pt")
    torch.save({old_key(k): v for k, v in state.items()}, f"{folder}/weights_transformers4.pt")
    torch.save({"state_dict": {"model." + k: v for k, v in state.items()}, "epoch": 3}, f"{folder}/lightning.ckpt")
    torch.save(m, f"{folder}/module.pt")
    save_file(state, f"{folder}/weights.safetensors")
    save_file({**inputs, **answers(m, inputs)}, f"{folder}/answers.safetensors")
    import stable_worldmodel, transformers
    json.dump({"torch": torch.__version__, "transformers": transformers.__version__,
               "stable-worldmodel": getattr(stable_worldmodel, "__version__", "0.1.1")}, open(f"{folder}/versions.json", "w"))


def check(folder):
    reference = load_file(f"{folder}/answers.safetensors")
    inputs = {k: reference[k] for k in ("frames", "candidates")}
    m = build()
    state = {k.replace("state_probe.net.", "state_probe."): v for k, v in load_file(f"{folder}/exported.safetensors").items()}
    m.load_state_dict(state, strict=True)
    original = load_file(f"{folder}/weights.safetensors")
    out = {"tensors_equal": sum(torch.equal(original[k], v) for k, v in m.state_dict().items()), "tensors": len(original)}
    for k, v in answers(m, inputs).items():
        out[k] = float(((v - reference[k]).abs() / (1 + reference[k].abs())).max())
    print(json.dumps(out))


{"make": make, "check": check}[sys.argv[1]](sys.argv[2])
