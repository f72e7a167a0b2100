"""Depth priors: the simulated errors have the declared size; files are read or refused."""

import os
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from minislam.data.images import encode_png, read_depth
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.depth import NoDepth, SensorDepth, SimulatedDepth
from minislam.priors.files import FileDepth
from minislam.records import Frame

CAMERA = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)
READ_PNG = partial(read_depth, units_per_metre=5000)


def frame(index: int, width: int = 80, height: int = 60) -> Frame:
    return Frame(index, index / 10, torch.zeros(height, width, 3))


def flat(depth: float):
    return lambda index: np.full((60, 80), depth)


# Simulated depth


def test_without_errors_the_simulation_returns_the_truth():
    simulated = SimulatedDepth(flat(3.0), 0, scale_error=0, field_error=0, gross_errors=0)
    depth = simulated(frame(4), CAMERA)
    torch.testing.assert_close(depth, torch.full((60, 80), 3.0))


def test_the_errors_have_the_declared_size():
    ratios = [SimulatedDepth(flat(2.0), seed=1)(frame(k), CAMERA) / 2.0 for k in range(200)]
    log_ratios = torch.stack(ratios).log()
    medians = log_ratios.flatten(1).median(dim=1).values
    # The median of a frame is its scale error, up to the field's own median.
    assert 0.025 < medians.std() < 0.05
    smooth = SimulatedDepth(flat(2.0), seed=1, scale_error=0, gross_errors=0)
    field = smooth(frame(0), CAMERA).div(2.0).log()
    assert abs(float(field.std(correction=0)) - 0.06) < 1e-4
    assert (field[:, 1:] - field[:, :-1]).abs().max() < 0.03  # smooth: no jump between pixels
    assert min(field.std(0).mean(), field.std(1).mean()) > 0.02  # along both axes


def test_gross_errors_are_of_thirty_percent_and_local():
    simulated = SimulatedDepth(flat(1.0), 2, scale_error=0, field_error=0, gross_errors=1)
    wrong = [simulated(frame(k), CAMERA) for k in range(40)]
    errors = torch.stack(wrong) - 1
    worst = errors.flatten(1).abs().max(dim=1).values
    assert worst.max() <= 0.3 + 1e-6
    assert (worst > 0.299).float().mean() > 0.9  # not all: a centre may lie outside by half
    assert errors.amax() > 0.29 and errors.amin() < -0.29  # both signs
    assert 0.01 < (errors.abs() > 1e-6).float().mean() < 0.05


def test_the_same_seed_and_frame_give_the_same_bytes_in_any_order():
    forward = SimulatedDepth(flat(2.0), seed=5)
    backward = SimulatedDepth(flat(2.0), seed=5)
    first = [forward(frame(k), CAMERA) for k in range(3)]
    second = [backward(frame(k), CAMERA) for k in (2, 1, 0)][::-1]
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[0], SimulatedDepth(flat(2.0), seed=6)(frame(0), CAMERA))


def test_unknown_stays_unknown_and_a_missing_truth_is_none():
    def truth(index: int) -> np.ndarray | None:
        depth = np.full((60, 80), 2.0)
        depth[:10] = 0
        return depth if index == 0 else None

    prior = SimulatedDepth(truth, seed=0)
    depth = prior(frame(0), CAMERA)
    assert (depth[:10] == 0).all() and (depth[10:] > 0).all()
    assert prior(frame(1), CAMERA) is None


def test_an_image_of_one_pixel_gets_a_finite_depth():
    depth = SimulatedDepth(lambda index: np.ones((1, 1)), 0)(frame(0, 1, 1), CAMERA)
    assert torch.isfinite(depth).all() and depth.shape == (1, 1)


# Depth from files


def test_npy_files_are_found_by_frame_index_with_and_without_leading_zeros(tmp_path: Path):
    np.save(tmp_path / "00003.npy", np.full((60, 80), 3, np.float32))
    np.save(tmp_path / "4.npy", np.full((1, 60, 80), 4, np.float32))
    prior = FileDepth(tmp_path, READ_PNG)
    assert prior(frame(3), CAMERA).unique().tolist() == [3.0]
    assert prior(frame(4), CAMERA).unique().tolist() == [4.0]
    assert prior(frame(5), CAMERA) is None


def test_sixteen_bit_png_is_scaled_by_the_declared_unit(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "000000.png"), np.full((60, 80), 5000, np.uint16))
    depth = FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)
    torch.testing.assert_close(depth, torch.ones(60, 80))


def test_a_depth_image_whose_name_is_no_text_is_read(tmp_path: Path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/d\xe9pth"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes text only")
    (folder / "0.png").write_bytes(encode_png(np.full((60, 80), 5000, np.uint16)))
    assert FileDepth(folder, READ_PNG)(frame(0), CAMERA).unique().tolist() == [1.0]


def test_another_size_is_resized_without_inventing_depths(tmp_path: Path):
    depth = np.where(np.arange(160) < 80, 1.0, 9.0)[None].repeat(120, 0)
    depth[:, 100] = np.nan
    depth[:, 102] = -1
    np.save(tmp_path / "0.npy", depth)
    read = FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)
    assert read.shape == (60, 80) and read.dtype == torch.float32
    assert set(read.unique().tolist()) <= {0.0, 1.0, 9.0}
    assert (read[:, :40] == 1).all() and (read[:, 52:] == 9).all()


def write_nothing(folder: Path) -> None:
    (folder / "notes.txt").write_text("x")


def write_pickle(folder: Path) -> None:
    np.save(folder / "0.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)


def write_flat(folder: Path) -> None:
    np.save(folder / "0.npy", np.zeros(7, np.float32))


def write_other_aspect(folder: Path) -> None:
    np.save(folder / "0.npy", np.ones((60, 60), np.float32))


def write_color_png(folder: Path) -> None:
    cv2.imwrite(str(folder / "0.png"), np.zeros((60, 80, 3), np.uint8))


def write_broken_png(folder: Path) -> None:
    (folder / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n")


@pytest.mark.parametrize(
    ("write", "sentence"),
    [
        (write_nothing, r"named by frame index .* found 0 such files"),
        (write_pickle, r"unreadable file .*0\.npy"),
        (write_flat, r"of shape \(rows, columns\) in .*0\.npy, found float32 of shape \(7,\)"),
        (write_other_aspect, r"found 60x60 of another aspect ratio"),
        (write_color_png, r"a 16-bit single-channel depth image, found uint8 .*0\.png"),
        (write_broken_png, r"whole PNG or JPEG image, but .*0\.png \(8 bytes\) is damaged"),
    ],
)
def test_bad_folders_are_refused_in_one_sentence(tmp_path: Path, write, sentence: str):
    write(tmp_path)
    with pytest.raises(InputError, match=sentence) as caught:
        FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)
    assert "\n" not in str(caught.value)


def test_a_missing_folder_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="found 0 such files"):
        FileDepth(tmp_path / "none", READ_PNG)


def test_an_empty_or_endless_array_and_depths_of_no_scene_are_refused(tmp_path: Path):
    np.save(tmp_path / "0.npy", np.zeros((0, 0), np.float32))
    with pytest.raises(InputError, match=r"floating-point depth of shape \(rows, columns\)"):
        FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)
    header = "{'descr': '<f4', 'fortran_order': False, 'shape': (10**6, 10**6), }"
    header = header.replace("10**6", "1000000").ljust(117) + "\n"
    content = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode()
    (tmp_path / "0.npy").write_bytes(content)  # 4 TB
    with pytest.raises(InputError, match="unreadable file"):
        FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)
    for depth in (1e30, 1e-30):
        np.save(tmp_path / "0.npy", np.full((CAMERA.height, CAMERA.width), depth, np.float32))
        with pytest.raises(InputError, match=r"expected depths of 0\.0001 to 100000 world units"):
            FileDepth(tmp_path, READ_PNG)(frame(0), CAMERA)


# The other two


def test_sensor_depth_passes_the_reader_on_and_cleans_it():
    prior = SensorDepth(lambda i: np.array([[1.0, np.inf], [0, 2]]) if i == 0 else None)
    torch.testing.assert_close(prior(frame(0, 2, 2), CAMERA), torch.tensor([[1.0, 0], [0, 2]]))
    assert prior(frame(1, 2, 2), CAMERA) is None


def test_no_depth_is_none():
    assert NoDepth()(frame(0), CAMERA) is None


def test_depths_in_another_unit_are_refused_although_some_pixels_are_unknown():
    depth = np.full((60, 80), 1e6)
    depth[0, :5] = 0
    with pytest.raises(InputError, match="write metres"):
        SensorDepth(lambda index: depth)(frame(0), CAMERA)
