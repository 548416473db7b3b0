"""Reads a live slot from shared memory by docs/formats/slot.md alone: numpy over mmap, nothing of gawm in between.

usage: read_slot.py PREFIX N OUT
Finds the slot that holds batch N in the files /dev/shm/PREFIX* and writes its arrays to OUT/<name>.bin; prints the header
as JSON.
"""

import glob
import json
import mmap
import os
import struct
import sys

import numpy as np

MAGIC = b"GAWMSLOT"
NAMES = ["clip_ids", "frames", "actions", "states", "action_mask", "state_mask", "frame_mask"]


def slots(memory):
    """Yields the offset of every slot: the magic at a multiple of 64 bytes."""
    at = memory.find(MAGIC)
    while at >= 0:
        if at % 64 == 0:
            yield at
        at = memory.find(MAGIC, at + 1)


def header(memory, at):
    version, length = struct.unpack_from("<II", memory, at + 8)
    assert (version, length) == (1, 320), (version, length)
    n, epoch, step = struct.unpack_from("<QQQ", memory, at + 112)
    split, loader, loaders, rank, ranks, clips = struct.unpack_from("<6I", memory, at + 136)
    shape = struct.unpack_from("<8I", memory, at + 160)
    offsets = struct.unpack_from("<7Q", memory, at + 192)
    (total,) = struct.unpack_from("<Q", memory, at + 248)
    return dict(n=n, epoch=epoch, step=step, split=split, loader=loader, loaders=loaders, rank=rank, ranks=ranks,
                clips=clips, shape=shape, offsets=offsets, total=total)


def arrays(memory, at, head):
    _, t, v, h, w, c, a, s = head["shape"]
    b = head["clips"]
    kinds = ["<u8", "u1", "<f4", "<f4", "u1", "u1", "u1"]
    shapes = [(b,), (b, t, v, h, w, c), (b, t, a), (b, t, s), (b, t), (b, t, s), (b, t, v)]
    for name, kind, shape, offset in zip(NAMES, kinds, shapes, head["offsets"]):
        assert offset % 64 == 0, name
        count = int(np.prod(shape))
        yield name, np.frombuffer(memory, dtype=kind, count=count, offset=at + offset).reshape(shape)


def main():
    prefix, wanted, out = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    for path in sorted(glob.glob("/dev/shm/" + glob.escape(prefix) + "*")):
        size = os.path.getsize(path)
        if size == 0:
            continue
        with open(path, "rb") as file:
            memory = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ)
        for at in slots(memory):
            head = header(memory, at)
            if head["n"] != wanted:
                continue
            for name, array in arrays(memory, at, head):
                array.tofile(os.path.join(out, name + ".bin"))
                if array.dtype == np.dtype("<f4"):
                    assert np.isfinite(array).all(), name
            print(json.dumps(head))
            return
    sys.exit(f"no slot with n = {wanted} in /dev/shm/{prefix}*")


main()
