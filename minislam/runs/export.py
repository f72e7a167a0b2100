"""What other programs go on with: COLMAP, nerfstudio, point clouds, depth and masks of a run.

The images have the size of the source and no distortion; a rolling shutter that the run has found
is undone in images and masks that come with poses. Masks are black where something moves,
as trainers of radiance fields read them, and cut where the map's own training cuts (weights.py).
The centre of our first pixel is (0, 0), theirs is (0.5, 0.5).
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from minislam.data.files import atomic_file, atomic_write, make_folder, write_json, write_text
from minislam.data.images import encode_png
from minislam.data.ply import encode_points
from minislam.data.run_folder import CAMERA, RUN
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.dense_flow import sample, warp
from minislam.runs.loaded import Run
from minislam.uncertainty import mapping_weight

HALF_PIXEL = 0.5  # px, from our pixel coordinates to those of COLMAP and nerfstudio
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # of camera axes: y up, z backward
IMAGES, MASKS, POINTS = "images", "masks", "points.ply"


def export_colmap(run: Run, folder: Path, frames: Iterable[int]) -> None:
    """Write images/, masks/ and sparse/0/ with COLMAP's text files, and the map as points."""
    camera, written = _write_images(run, folder, frames)
    fx, fy, cx, cy, *size = vars(camera).values()
    lens = (fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL)
    write_text(folder / "sparse/0/cameras.txt", _row([1, "PINHOLE", *size, *lens]))
    rows = ""
    for number, frame in enumerate(written, start=1):
        T_camera_world = np.linalg.inv(run.poses[frame])
        x, y, z, w = Rotation.from_matrix(T_camera_world[:3, :3]).as_quat()
        rows += _row([number, w, x, y, z, *T_camera_world[:3, 3], 1, _name(frame)])
        rows += "\n"  # no points of the image
    write_text(folder / "sparse/0/images.txt", rows)
    points = zip(*points_of(run), strict=True)
    rows = "".join(_row([k, *xyz, *rgb, 0]) for k, (xyz, rgb) in enumerate(points, start=1))
    write_text(folder / "sparse/0/points3D.txt", rows)


def export_nerfstudio(run: Run, folder: Path, frames: Iterable[int]) -> None:
    """Write images/, masks/, the map as points.ply, and transforms.json for nerfstudio."""
    camera, written = _write_images(run, folder, frames)
    export_points(run, folder / POINTS)
    views = [
        {
            "file_path": f"{IMAGES}/{_name(frame)}",
            "mask_path": f"{MASKS}/{_name(frame)}",
            "transform_matrix": (run.poses[frame] @ OPENCV_TO_OPENGL).tolist(),
        }
        for frame in written
    ]
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "w": camera.width, "h": camera.height}
    lens |= {"cx": camera.cx + HALF_PIXEL, "cy": camera.cy + HALF_PIXEL}
    model = {"camera_model": "OPENCV", **lens, "ply_file_path": POINTS, "frames": views}
    write_json(folder / "transforms.json", model)


def export_points(run: Run, file: Path) -> None:
    """Write the opaque Gaussians as a plain coloured point cloud."""
    atomic_write(file, encode_points(*points_of(run)))


def export_depth(run: Run, folder: Path, frames: Iterable[int]) -> None:
    """Write the z-depth of the map in every frame as .npy, float32 of the working size.

    camera.json holds the intrinsics, for pixel centres at integers, and the unit of length.
    """
    _make_apart(run, folder)
    for frame in frames:
        with atomic_file(folder / _name(frame, ".npy")) as file:
            np.save(file, np.asarray(run.render_depth(run.poses[frame]), np.float32))
    write_json(folder / CAMERA, {**asdict(run.camera), "unit": run.unit})


def export_masks(run: Run, folder: Path, frames: Iterable[int]) -> None:
    """Write a mask of every frame at the size of the source: 255 where static, 0 where it moves."""
    camera = run.sequence.prepare.full_camera(run.camera)
    _make_apart(run, folder)
    for frame in frames:
        atomic_write(folder / _name(frame), encode_png(static_mask(run, frame, camera)))


def points_of(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (N, 3) and colours (N, 3) uint8 of the Gaussians that hide more than half."""
    opaque = run.gaussians.opacity_logits > 0
    colors = np.round(255 * np.clip(run.gaussians.colors[opaque], 0, 1)).astype(np.uint8)
    return run.gaussians.means[opaque], colors


def static_mask(run: Run, frame: int, camera: Camera) -> np.ndarray:  # (H, W) uint8, 255 or 0
    """Return where a frame is static, for another image size of the same view."""
    beta = sample(run.beta(frame), _working_pixels(run, camera))
    raw = torch.from_numpy(np.asarray(beta, np.float32))
    return np.where(mapping_weight(raw, camera, run.least_weight) > 0, 255, 0).astype(np.uint8)


def _write_images(run: Run, folder: Path, frames: Iterable[int]) -> tuple[Camera, list[int]]:
    """Write images/ and masks/; return the camera of both, and the frames."""
    sequence = run.sequence
    _make_apart(run, folder, IMAGES, MASKS, "sparse/0")
    camera, written = sequence.prepare.full_camera(run.camera), list[int]()
    for frame in frames:
        image, mask = sequence.full_image(frame), static_mask(run, frame, camera)
        moved = run.displacement(frame)
        if moved is not None:
            enlarged = sample(moved, _working_pixels(run, camera)) * (camera.fx / run.camera.fx)
            image = warp(image, enlarged, cv2.INTER_CUBIC)
            mask = warp(mask, enlarged, cv2.INTER_NEAREST)
        atomic_write(folder / IMAGES / _name(frame), encode_png(image))
        atomic_write(folder / MASKS / _name(frame), encode_png(mask))
        written.append(frame)
    return camera, written


def _make_apart(run: Run, folder: Path, *parts: str) -> None:
    """Make an output folder and its parts; refuse that of a run, or of images of its source."""
    make_folder(folder := folder.resolve())
    if (folder / RUN).exists():  # whose camera.json would be replaced
        raise InputError(f"expected a folder of no run, found {RUN} in {folder}; choose another")
    if any(folder.iterdir()):  # only then, because depth can be written without the source
        links = (path.resolve() for path in folder.rglob("*") if path.is_symlink())
        places = {folder, *links}  # what a link points to would be replaced, too
        files = (file.resolve() for file in run.sequence.files)
        if inside := [file for file in files if places & {file, *file.parents}]:
            wanted = "a folder without images of the sequence itself, or links to them"
            raise InputError(f"expected {wanted}, found {inside[0]}; choose another")
    for part in parts:
        make_folder(folder / part)


def _working_pixels(run: Run, camera: Camera) -> np.ndarray:  # (H, W, 2)
    """Return the column and row in the run's images of every pixel of another size."""
    columns = (np.arange(camera.width) - camera.cx) / camera.fx * run.camera.fx + run.camera.cx
    rows = (np.arange(camera.height) - camera.cy) / camera.fy * run.camera.fy + run.camera.cy
    return np.stack(np.meshgrid(columns, rows), -1).astype(np.float32)


def _name(frame: int, ending: str = ".png") -> str:
    return f"{frame:06d}{ending}"


def _row(values: Sequence[object]) -> str:
    """Return a line of COLMAP's text files, with numbers to the last digit."""
    return " ".join(v if isinstance(v, str) else repr(np.asarray(v).item()) for v in values) + "\n"
