"""Write sequences as TUM RGB-D folders, whole or not at all.

rgb/<timestamp>.png  depth/<timestamp>.png   8-bit colour; 16-bit depth, 5000 units per metre
rgb.txt  depth.txt                           timestamp and file name
groundtruth.txt                              timestamp tx ty tz qx qy qz qw, camera to world
calibration.txt                              fx fy cx cy width height k1 k2 p1 p2 k3; no phone's
masks/<timestamp>.png                        255 where a mover is seen
static/<timestamp>.png                       the same view without movers and their shadows
novel/<index>.png  novel/poses.txt           held-out views of the still world
synth.json                                   what was generated; written last
"""

import json
import os
import shutil
import tempfile
import time
import zlib
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from .errors import SynthError
from .phone import Phone, phone_intrinsics
from .poses import Array, Intrinsics, default_intrinsics
from .scenes import Scene, scene
from .sequence import (
    Progress,
    SyntheticFrame,
    check_request,
    in_order,
    novel_image,
    novel_poses,
    render_frame,
)

GENERATOR_VERSION = 10  # raise it whenever the same arguments give other files
DEPTH_UNITS_PER_METRE = 5000  # of TUM RGB-D
PNG_COMPRESSION = 1  # of 9: noise does not compress, and level 1 is several times faster
RECORD = "synth.json"
STALE = 24 * 3600.0  # s, after which nobody renders into a scratch folder any more
IMAGE_FOLDERS = ("rgb", "depth", "masks", "static", "novel")


def write_sequence(
    name: str,
    seed: int,
    frames: int,
    size: tuple[int, int],  # width, height
    folder: Path | str,
    progress: Progress | None = None,
    phone: Phone | None = None,
) -> Path:
    """Write a sequence into a folder; a complete one with the same parameters is kept."""
    check_request(frames, size)
    folder = Path(os.path.realpath(folder))  # of a link, what it points to is replaced
    record = {
        "name": name,
        "seed": seed,
        "frames": frames,
        "size": list(size),
        "generator_version": GENERATOR_VERSION,
    }
    if phone:
        record["phone"] = asdict(phone)
    replaces = _may_replace(folder, record)
    if replaces is None:
        return folder
    if replaces and folder.samefile("."):  # a shell in it would stand in a folder that is gone
        raise SynthError(f"{folder} is the folder you are in and cannot be replaced: name another")
    view = scene(name, seed)
    intrinsics = phone_intrinsics(size) if phone else default_intrinsics(size)
    folder.parent.mkdir(parents=True, exist_ok=True)
    # A sibling on the same file system: the final rename is one step, so nobody ever finds a folder
    # that is half written, and two processes that write the same sequence do not meet.
    scratch = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        _write_content(scratch, view, intrinsics, frames, progress, phone)
        (scratch / RECORD).write_text(json.dumps(record, indent=2) + "\n")
        scratch.chmod(0o755)
        _put_in_place(scratch, folder, record)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return folder


def cached_sequence(
    name: str,
    seed: int = 0,
    frames: int = 100,
    size: tuple[int, int] = (320, 240),
    progress: Progress | None = None,
    phone: Phone | None = None,
) -> Path:
    """Return the folder of a sequence in the cache, generating it on first use.

    The cache is $MINISLAM_CACHE, or ~/.cache/minislam.
    """
    root = Path(os.path.expanduser(os.environ.get("MINISLAM_CACHE") or "~/.cache/minislam"))
    if str(root).startswith("~"):
        raise SynthError(f"there is no home folder for {root}: set MINISLAM_CACHE to a folder")
    filmed = "" if phone is None else f"-phone-{zlib.crc32(repr(phone).encode()):08x}"
    folder = root / "synth" / f"{name}-{seed}-{frames}-{size[0]}x{size[1]}{filmed}"
    for scratch in root.glob("synth/.*-*-*-*x*-????????"):  # left by a killed process
        with suppress(OSError):  # another process has just finished and renamed it
            if time.time() - scratch.stat().st_mtime > STALE and not scratch.is_symlink():
                shutil.rmtree(scratch, ignore_errors=True)
    return write_sequence(name, seed, frames, size, folder, progress, phone)


def _may_replace(folder: Path, record: dict) -> bool | None:
    """Return None if the folder already is the sequence, else whether it has to be replaced."""
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise SynthError(f"{folder} is a file: name a folder for the sequence")
    if not any(folder.iterdir()):
        return True
    try:
        found = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        found = None
    if not isinstance(found, dict) or "generator_version" not in found:
        raise SynthError(f"{folder} holds other files: name a new or an empty folder")
    if found == record:
        return None
    if {**found, "generator_version": 0} == {**record, "generator_version": 0}:
        return True  # the same sequence from another version of the generator
    raise SynthError(
        f"{folder} holds the sequence {found.get('name')!r} with seed {found.get('seed')}, "
        f"{found.get('frames')} frames, size {found.get('size')}: name another folder"
    )


def _put_in_place(scratch: Path, folder: Path, record: dict) -> None:
    """Rename the finished folder to its name."""
    replaces = _may_replace(folder, record)
    if replaces is None:
        return  # another process was faster, with the same bytes
    if replaces:
        shutil.rmtree(folder)
    try:
        os.rename(scratch, folder)
    except OSError:
        # Another process may have put the same sequence there since we looked.
        if not folder.exists() or _may_replace(folder, record) is not None:
            raise


def _write_content(
    folder: Path,
    view: Scene,
    intrinsics: Intrinsics,
    frames: int,
    progress: Progress | None,
    phone: Phone | None,
) -> None:
    for image_folder in IMAGE_FOLDERS:
        (folder / image_folder).mkdir()

    def render_and_write(index: int) -> SyntheticFrame:
        frame = render_frame(view, intrinsics, index, phone=phone)
        _write_images(folder, frame)
        return frame

    trajectory = []
    for frame in in_order(render_and_write, frames):
        trajectory.append((f"{frame.timestamp:.6f}", frame.T_world_camera))
        if progress:
            progress(len(trajectory), frames)
    _write_lists(folder, view.name, trajectory)
    if phone is None or phone.calibrated:
        _write_calibration(folder, intrinsics)

    poses = novel_poses(view, frames)
    images = in_order(lambda index: novel_image(view, intrinsics, poses[index]), len(poses))
    for index, image in enumerate(images):
        _write_image(folder / "novel" / f"{index:03d}.png", image[..., ::-1])
    rows = [(str(index), pose) for index, pose in enumerate(poses)]
    _write_trajectory(folder / "novel" / "poses.txt", "index", rows)


def _write_images(folder: Path, frame: SyntheticFrame) -> None:
    file_name = f"{frame.timestamp:.6f}.png"
    depth = np.round(frame.depth.astype(np.float64) * DEPTH_UNITS_PER_METRE)
    _write_image(folder / "rgb" / file_name, frame.rgb[..., ::-1])
    _write_image(folder / "static" / file_name, frame.static_rgb[..., ::-1])
    _write_image(folder / "masks" / file_name, frame.mask.astype(np.uint8) * 255)
    _write_image(folder / "depth" / file_name, np.clip(depth, 0, 65535).astype(np.uint16))


def _write_image(path: Path, image: Array) -> None:
    """Write a PNG; colour comes in the order blue, green, red."""
    png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1]
    path.write_bytes(png.tobytes())  # on Windows cv2.imwrite fails at names with an umlaut


def _write_lists(folder: Path, name: str, trajectory: list[tuple[str, Array]]) -> None:
    for kind, title in (("rgb", "color images"), ("depth", "depth maps")):
        rows = [f"{stamp} {kind}/{stamp}.png\n" for stamp, _ in trajectory]
        header = f"# {title}\n# sequence: synthetic {name}\n# timestamp filename\n"
        (folder / f"{kind}.txt").write_text(header + "".join(rows))
    _write_trajectory(folder / "groundtruth.txt", "timestamp", trajectory)


def _write_calibration(folder: Path, c: Intrinsics) -> None:
    values = f"{c.fx:.9g} {c.fy:.9g} {c.cx:.9g} {c.cy:.9g} {c.width} {c.height} 0 0 0 0 0\n"
    (folder / "calibration.txt").write_text(
        "# fx fy cx cy width height k1 k2 p1 p2 k3\n"
        "# pixels; the centre of the first pixel is (0, 0)\n" + values
    )


def _write_trajectory(path: Path, key: str, rows: list[tuple[str, Array]]) -> None:
    lines = ["# camera-to-world poses of a synthetic scene, metres\n", "# z is up\n"]
    lines.append(f"# {key} tx ty tz qx qy qz qw\n")
    for stamp, pose in rows:
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        numbers = np.concatenate([pose[:3, 3], quaternion])
        lines.append(stamp + " " + " ".join(f"{number:.9f}" for number in numbers) + "\n")
    path.write_text("".join(lines))
