"""Bad files for `bad_inputs`: images, videos, lists, depth, weights, checkpoints."""

import io
import os
import pickle
import socket
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import torch

from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from tests.benchmarks.bad_input_case import (
    ACCEPTED,
    EITHER,
    REFUSED,
    RUN,
    WARNED,
    Case,
    Spoil,
    content,
    replaced,
)

CODE = pickle.dumps(compile)  # a pickle that names a function


def changed(name: str, change: Callable[[bytes], bytes]) -> Spoil:
    """Return what changes the bytes of a file."""
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


def picture(kind: str, *shape: int, dtype: str = "uint8", value: float | None = None) -> bytes:
    """Return an encoded picture of noise, or of one value."""
    image = np.random.default_rng(0).integers(0, 255, shape).astype(dtype)
    return cv2.imencode(kind, image if value is None else np.full_like(image, value))[1].tobytes()


def npy(array: np.ndarray, pickled: bool = False) -> bytes:
    """Return the bytes of an .npy file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=pickled)
    return file.getvalue()


def at(fraction: float, new: bytes) -> Callable[[bytes], bytes]:
    """Return what overwrites bytes at a fraction of a file."""

    def change(data: bytes) -> bytes:
        start = int(fraction * len(data))
        return data[:start] + new + data[start + len(new) :]

    return change


def cut(fraction: float) -> Callable[[bytes], bytes]:
    """Return what keeps the first part of a file."""
    return lambda data: data[: int(fraction * len(data))]


NOISE = np.random.default_rng(1).integers(0, 256, 400, dtype=np.uint8).tobytes()
FOREIGN = {"nothing": b"", "a text": b"this is a text", "zeros": bytes(500), "noise": NOISE,
           "a GIF": b"GIF89a" + bytes(60), "HTML": b"<!doctype html>404"}  # fmt: skip


def png_header(width: int, height: int) -> Callable[[bytes], bytes]:
    """Return what changes the size that a PNG claims, its check sum left as it was."""
    return lambda data: data[:16] + struct.pack(">II", width, height) + data[24:]


BYTES = {f"cut at {f}": cut(f) for f in (0.02, 0.3, 0.6, 0.9, 0.99)} | {
    f"noise at {f}": at(f, NOISE[:40]) for f in (0.0, 0.2, 0.5, 0.8)
}
TEXTS = {"nothing": "", "a comment": "# nothing\n", "a word": "hello\n", "NaN": "nan " * 8,
         "infinite": "inf " * 8, "1e400": "1e400 " * 8, "UTF-16": "1 2 3 4".encode("utf-16"),
         "binary": NOISE, "NUL": "1\0 2 3 4\n", "JSON": "{}"}  # fmt: skip


def images() -> Iterator[Case]:
    """Pictures of a folder, the first or a later one."""
    for place in (0, 2):
        for folder, kind in (("good", "png"), ("photos", "jpg")):
            name, command = f"{folder}/{place}.{kind}", RUN.format(folder)
            for label, data in FOREIGN.items():
                yield Case("images", f"{label} as {name}", command, content(name, data))
            for label, change in BYTES.items():
                case = Case("images", f"{label} of {name}", command, changed(name, change))
                case.expected = WARNED if kind == "jpg" else REFUSED
                yield case
            shapes = ((1, 1, 3), (8, 8, 3), (15, 200, 3), (73, 96, 3), (72, 97, 3), (96, 72, 3))
            for shape in shapes:
                data = picture(f".{kind}", *shape)
                yield Case("images", f"{shape} as {name}", command, content(name, data))
        name = f"good/{place}.png"
        for size in ((100_000, 100_000), (0, 72), (2**31, 1), (96, 71)):
            spoil = changed(name, png_header(*size))
            yield Case("images", f"{name} claims {size}", RUN.format("good"), spoil)
        for make in (Path.mkdir, os.mkfifo, lambda path: path.symlink_to("nowhere")):
            spoil = replaced(name, make)
            yield Case("images", f"{name} by {make}", RUN.format("good"), spoil, EITHER)
        for extra in ({"dtype": "uint16"}, {"value": 0}):
            spoil = content(name, picture(".png", 72, 96, **extra))
            yield Case("images", f"{name} {extra}", RUN.format("good"), spoil, ACCEPTED)


def videos() -> Iterator[Case]:
    """Videos cut and damaged: refused, or warned of."""
    for name in ("clip.mp4", "clip.mkv"):
        for label, data in FOREIGN.items():
            yield Case("videos", f"{label} as {name}", RUN.format(name), content(name, data))
        for label, change in BYTES.items():
            spoil = changed(name, change)
            yield Case("videos", f"{label} of {name}", RUN.format(name), spoil, EITHER)
        for start in (0.3, 0.5, 0.7):
            spoil = changed(name, at(start, bytes(300)))
            yield Case("videos", f"{name}, zeros at {start}", RUN.format(name), spoil, EITHER)
    for name, make in (("fifo", os.mkfifo), ("socket", _socket)):
        yield Case("videos", name, RUN.format(name), replaced(name, make))
    for name in ("/dev/null", "/dev/zero", "/proc/self/mem", "mine.txt", "truth.txt", "good/0.png"):
        yield Case("videos", name, RUN.format(name))


def _socket(path: Path) -> None:
    socket.socket(socket.AF_UNIX).bind(str(path))


def lists() -> Iterator[Case]:
    """Text files of a TUM folder."""
    stamp = "100.000000"
    rows = [f"{100 + k / 10:.6f} rgb/{100 + k / 10:.6f}.png" for k in range(6)]
    rgb = {"unsorted": "\n".join(rows[::-1]), "doubled": "\n".join([rows[0], *rows]),
           "missing": "1 a.png", "a folder": "1 rgb", "far away": "1 ../../../../../etc/passwd",
           "absolute": "1 /etc/passwd", "long": "1 " + "a" * 5000,
           "comma": rows[0].replace(".", ","),
           "close": f"1 {rows[0].split()[1]}\n1.0000001 {rows[1].split()[1]}",
           "no name": stamp, "negative NaN": f"-nan {rows[0]}"}  # fmt: skip
    pose = f"{stamp} 0 0 0 0 0 0 1\n"
    truth = {"7 columns": f"{stamp} 0 0 0 0 0 1\n", "9 columns": pose.replace("\n", " 0\n"),
             "zero quaternion": f"{stamp} 0 0 0 0 0 0 0\n", "norm 2": f"{stamp} 0 0 0 0 0 0 2\n",
             "commas": pose.replace(" ", ","), "unsorted": pose + "1 0 0 0 0 0 0 1\n"}  # fmt: skip
    sizes = ("0 0", "-48 32", "48.5 32", "32 48", "1e30 1e30", "nan 32", "48")
    numbers = ["1 2 3", "1 2 3 4 5", "nan 41 23 16", "-40 41 23 16", "0 41 23 16", "40 0 23 16",
               "40 41 -500 16", "40 41 23 9000", "40,5 41,5 23 16", "fx=40 fy=41 cx=23 cy=16",
               "1e300 1e300 23 16", "40 41 23 16 48 32 9 9 9 9 9",
               "40 41 23 16 48 32 0 0 0 0 1e30", "40 41 23 16 48 32 .1 .1"]  # fmt: skip
    numbers += [f"40 41 23 16 {size}" for size in sizes]
    tables = {"rgb.txt": rgb, "groundtruth.txt": truth, "depth.txt": rgb,
              "calibration.txt": {text: text for text in numbers},
              "novel/poses.txt": truth}  # fmt: skip
    for name, table in tables.items():
        for label, text in (TEXTS | table).items():
            spoil, command = content(f"tum/{name}", text), RUN.format("tum --depth sensor")
            case = Case("lists", f"{label} as {name}", command, spoil)
            if name == "depth.txt" and label in ("a comment", "nothing"):
                case.expected = EITHER
            yield case
    for folder, depth in (("depth", "sensor"), ("masks", "none")):
        name, command = f"tum/{folder}/100.200000.png", f"tum --depth {depth}"
        command = RUN.format(command + " --uncertainty.given_masks on" * (folder == "masks"))
        for label, data in FOREIGN.items():
            yield Case("lists", f"{label} as {name}", command, content(name, data))
        for shape in ((1, 1), (33, 48), (32, 48, 3)):
            spoil = content(name, picture(".png", *shape))
            expected = EITHER if (folder, len(shape)) == ("masks", 3) else REFUSED
            yield Case("lists", f"{shape} as {name}", command, spoil, expected)


def priors() -> Iterator[Case]:
    """Files of depth, of features and of masks; weights; plugins."""
    full = np.full((72, 96), 2.0, np.float32)
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000)}"
    header = b"\x93NUMPY\x01\x00v\x00" + header
    arrays = {"integers": npy(full.astype(int)), "complex": npy(full * 1j), "bool": npy(full > 0),
              "empty": npy(full[:0]), "a line": npy(full[0]),
              "code": npy(np.array([compile]), True),
              "objects": npy(full.astype(object), True), "4 TB": header.ljust(128) + b"\n",
              "four axes": npy(np.ones((2, 2, 2, 2), np.float32)), "strings": npy(np.array(["a"])),
              "another aspect": npy(np.ones((72, 40), np.float32)), "pickle": CODE}  # fmt: skip
    cases = {"depth": {"1e30": npy(full * 1e30), "1e-30": npy(full * 1e-30)},
             "features": {"NaN": npy(np.full((9, 12, 5), np.nan, np.float32)),
                          "channels": npy(np.ones((9, 12, 4), np.float32))}}  # fmt: skip
    for kind, more in cases.items():
        command = RUN.format(f"good --{kind} files:{kind}")
        for label, data in (FOREIGN | arrays | more).items():
            spoil = content(f"{kind}/1.npy", data)
            yield Case("priors", f"{kind}: {label}", command, spoil)
        for label, change in BYTES.items():
            spoil, expected = changed(f"{kind}/1.npy", change), EITHER
            yield Case("priors", f"{kind}: {label}", command, spoil, expected)
        for text in ("hello", "1", "a b", "0 nan", "0 1 2", "7 99.0"):
            spoil = content(f"{kind}/frames.txt", text)
            yield Case("priors", f"{kind}: index {text}", command, spoil)
    masked = RUN.format("good --masks files:masks")
    for label, data in FOREIGN.items():
        yield Case("priors", f"masks: {label}", masked, content("masks/1.png", data))
    for label, data in {
        "of ones": picture(".png", 72, 96, value=1),
        "small": picture(".png", 9, 9),
    }.items():
        yield Case("priors", f"masks: {label}", masked, content("masks/1.png", data))
    yield Case("priors", "masks: missing", masked, replaced("masks/1.png", lambda path: None))
    saved = io.BytesIO()
    torch.save({"a": torch.ones(3)}, saved)
    files = FOREIGN | {
        "other tensors": saved.getvalue(),
        "code": CODE,
        "half": saved.getvalue()[:200],
    }
    for kind, name in (("flow", "droid"), ("features", "fit3d"), ("features", "dinov2"),
                       ("depth", "metric3d"), ("depth", "depth-anything")):  # fmt: skip
        for label, data in files.items():
            command = RUN.format(f"good --{kind} {name} --{kind}-weights w.pth")
            yield Case("priors", f"{name}: {label}", command, content("w.pth", data))
    bodies = {"nowhere": "", "broken": "def f(:", "no f": "",
              "raises": "def f(d): raise ValueError",
              "None": "def f(d): return None", "a number": "def f(d): return 3",
              "wrong": "def f(d): return lambda *a: 3",
              "exits": "import sys; sys.exit(5)"}  # fmt: skip
    for kind in ("flow", "features", "depth"):
        for label, body in bodies.items():
            name = "python:nowhere:f" if label == "nowhere" else "python:plugin:f"
            spoil = content("plugin.py", body)
            yield Case("priors", f"{kind} {label}", RUN.format(f"good --{kind} {name}"), spoil)


def checkpoints() -> Iterator[Case]:
    """The checkpoint of an interrupted run, changed."""
    name, command = "run/checkpoint.npz", "run --resume -o run --workers 1 -q"
    for label, data in (FOREIGN | {"pickle": CODE, "an array": npy(np.ones(3))}).items():
        yield Case("checkpoints", label, command, content(name, data))
    for label, change in BYTES.items():
        yield Case("checkpoints", label, command, changed(name, change))
    wrong: list[object] = [None, [], "text", -3, {}]
    for key in ("slam", "run_seconds", "checksums", "version", "settings", "sequence"):
        for value in wrong:
            if (key, value) not in (("run_seconds", -3), ("checksums", {})):
                yield Case("checkpoints", f"{key} = {value}", command, tree(key, value))
    for part in ("steps", "tracker", "mapper"):
        for value in wrong:
            yield Case(
                "checkpoints", f"slam.{part} = {value}", command, tree(f"slam.{part}", value)
            )
    for text in ("", "{}", "[]", '{"sequence": "nowhere"}'):
        yield Case("checkpoints", f"config.json {text}", command, content("run/config.json", text))
    spoil = content("good/1.png", picture(".png", 72, 96, 3))
    yield Case("checkpoints", "another frame", command.replace("run", "run good", 1), spoil)


def tree(path: str, value: object) -> Spoil:
    """Return what replaces a part of a checkpoint."""

    def spoil(folder: Path) -> None:
        file = folder / "run/checkpoint.npz"
        whole = node = read_checkpoint(file)
        *parents, last = path.split(".")
        for name in parents:
            node = node[name]
        node[last] = value
        write_checkpoint(file, whole)

    return spoil
