"""Writes gymnasium_mujoco.bin from a gymnasium_mujoco.npz: python3 golden.py FROM.npz TO.bin

The .npz has three episodes of up to 40 steps of each of Gymnasium 1.4's eleven v5 MuJoCo tasks, computed by Gymnasium on
mujoco 2.2.2: for each `task/seed` the arrays qpos [Q], qvel [V] of the initial state, actions [T, A] (float32),
observations [T + 1, O], rewards [T] and terminated [T]. The .bin has for each episode, little-endian: the length of the
task's name and the seed as u16, the name, Q, V, A, O and T as u16, then qpos and qvel as f64, the actions and the
observations as f32, the rewards as f64, and for each step a byte that is 1 if the step terminated the episode.
"""

import ast
import struct
import sys
import zipfile


def load(archive: zipfile.ZipFile, name: str) -> tuple[str, tuple[int, ...], bytes]:
    """Reads an array. Returns its type, its shape and its bytes, row-major."""
    raw = archive.read(name)
    length = struct.unpack("<H", raw[8:10])[0]
    header = ast.literal_eval(raw[10 : 10 + length].decode())
    assert not header["fortran_order"]
    return header["descr"], header["shape"], raw[10 + length :]


def main(source: str, target: str) -> None:
    with zipfile.ZipFile(source) as archive, open(target, "wb") as out:
        episodes = sorted({name.rsplit("/", 1)[0] for name in archive.namelist()})
        for episode in episodes:
            task, seed = episode.split("/")
            parts = {}
            for key in ("qpos", "qvel", "actions", "observations", "rewards", "terminated"):
                kind, shape, raw = load(archive, f"{episode}/{key}.npy")
                if (key, kind) == ("rewards", "<i8"):
                    kind, raw = "<f8", struct.pack(f"<{shape[0]}d", *struct.unpack(f"<{shape[0]}q", raw))
                assert kind == {"actions": "<f4", "terminated": "|b1"}.get(key, "<f8"), (key, kind)
                parts[key] = (shape, raw)
            shape, observations = parts["observations"]
            count = shape[0] * shape[1]
            singles = struct.pack(f"<{count}f", *struct.unpack(f"<{count}d", observations))
            sizes = (parts["qpos"][0][0], parts["qvel"][0][0], parts["actions"][0][1], shape[1], shape[0] - 1)
            out.write(struct.pack("<HH", len(task), int(seed)) + task.encode() + struct.pack("<5H", *sizes))
            out.write(parts["qpos"][1] + parts["qvel"][1] + parts["actions"][1] + singles)
            out.write(parts["rewards"][1] + parts["terminated"][1])


main(*sys.argv[1:])
