"""Priors made elsewhere: each file finds its frame, and whatever does not fit is refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.files import (
    DEPTH,
    FEATURES,
    INDEX,
    FileDepth,
    FileFeatures,
    FrameFiles,
    folder_of,
    index_text,
)
from minislam.records import Frame
from tests.helpers import frame_of

IMAGE = torch.zeros(60, 80, 3)
CAMERA = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)


def grid(value: float, rows: int = 4, cols: int = 5, channels: int = 6) -> np.ndarray:
    return np.full((rows, cols, channels), value, np.float32)


def folder_with(folder: Path, files: dict[str, np.ndarray]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, values in files.items():
        np.save(folder / name, values)
    return folder


# Known answers


def test_features_are_those_of_the_frame(tmp_path: Path):
    features = FileFeatures(folder_with(tmp_path, {"00003.npy": grid(3), "4.npy": grid(4)}), CAMERA)
    assert (features.dimension, features.stride) == (6, 15)
    assert torch.equal(features(frame_of(IMAGE, 3)), torch.full((4, 5, 6), 3.0))
    assert torch.equal(features(frame_of(IMAGE, 4)), torch.full((4, 5, 6), 4.0))


def test_half_precision_is_read_as_single(tmp_path: Path):
    features = FileFeatures(folder_with(tmp_path, {"0.npy": grid(0.5).astype(np.float16)}), CAMERA)
    assert features(frame_of(IMAGE)).dtype == torch.float32


def test_with_an_index_files_belong_to_moments(tmp_path: Path):
    # Made for every frame of 10 per second; a run uses every third, from the second on.
    folder_with(tmp_path, {f"{k:05d}.npy": grid(k) for k in range(8)})
    (tmp_path / INDEX).write_text(index_text("made up", [(k, k / 10) for k in range(8)]))
    features = FileFeatures(tmp_path, CAMERA)
    for position, index in enumerate(range(1, 8, 3)):
        frame = Frame(position, index / 10, IMAGE)
        assert features(frame).unique().tolist() == [index]


def test_depth_finds_its_moment_as_well_and_may_be_unknown_there(tmp_path: Path):
    folder_with(tmp_path, {"2.npy": np.full((60, 80), 2, np.float32)})
    (tmp_path / INDEX).write_text(index_text("made up", [(1, 0.5), (2, 0.75)]))
    depth = FileDepth(tmp_path, Path.exists)  # there are only arrays
    assert depth(Frame(0, 0.75, IMAGE), CAMERA).unique().tolist() == [2.0]
    assert depth(Frame(1, 0.5, IMAGE), CAMERA) is None
    with pytest.raises(InputError, match=r"depth of the frame at 0\.600000 s, found no such frame"):
        depth(Frame(0, 0.6, IMAGE), CAMERA)


def test_a_folder_of_both_kinds_or_of_one_can_be_named(tmp_path: Path):
    assert folder_of(str(tmp_path), FEATURES) == tmp_path
    for name in ("features", "depths"):
        (tmp_path / name).mkdir()
    assert folder_of(str(tmp_path), FEATURES) == tmp_path / "features"
    assert folder_of(str(tmp_path), DEPTH) == tmp_path / "depths"  # as WildGS-SLAM calls it
    (tmp_path / "depth").mkdir()
    assert folder_of(str(tmp_path), DEPTH) == tmp_path / "depth"


@pytest.mark.parametrize(
    ("height", "width", "patch"), [(240, 320, 14), (384, 512, 14), (97, 61, 7), (60, 80, 16)]
)
def test_every_grid_of_whole_patches_covers_its_image(
    height: int, width: int, patch: int, tmp_path: Path
):
    files = {"0.npy": grid(1, height // patch, width // patch)}
    image = torch.zeros(height, width, 3)
    assert FileFeatures(folder_with(tmp_path, files), CAMERA)(frame_of(image)).shape[2] == 6


# Errors


def text_file(folder: Path) -> None:
    (folder / "0.npy").write_text("not an array")


def truncated(folder: Path) -> None:
    np.save(folder / "0.npy", grid(1))
    whole = (folder / "0.npy").read_bytes()
    (folder / "0.npy").write_bytes(whole[:-8])


def saved(values: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / "0.npy", values)


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (lambda folder: None, r"\.npy files named by frame index .* found 0 such files"),
        (text_file, r"unreadable file .*0\.npy"),
        (truncated, r"unreadable file .*0\.npy"),
        (saved(grid(1)[0]), r"\(rows, columns, channels\) in .*0\.npy, found float32 .*\(5, 6\)"),
        (saved(grid(np.nan)), r"expected finite features"),
        (saved(grid(1).astype(np.int32)), r"floating-point features .* in .*0\.npy, found int32"),
        (saved(grid(1, 5, 4)), r"cover the image of 80x60, found a grid of 4x5"),
    ],
)
def test_bad_folders_of_features_are_one_sentence(tmp_path: Path, write, words: str):
    write(tmp_path)
    with pytest.raises(InputError, match=words) as caught:
        FileFeatures(tmp_path, CAMERA)(frame_of(IMAGE))
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_another_network_are_refused(tmp_path: Path):
    files = {"0.npy": grid(1), "1.npy": grid(1, channels=7)}
    with pytest.raises(InputError, match=r"of every frame in .*, 3 files, found 2"):
        FileFeatures(folder_with(tmp_path, files), CAMERA, Images(["a", "b", "c"]))
    features = FileFeatures(tmp_path, CAMERA, Images(["a", "b"]))
    with pytest.raises(InputError, match="found none for frame 2"):
        features(frame_of(IMAGE, 2))
    with pytest.raises(InputError, match=r"of 6 channels in .*1\.npy, found 7"):
        features(frame_of(IMAGE, 1))


class Images:
    """A sequence of which only the names of its images are known, from one on."""

    def __init__(self, names: list[str], start: int = 0, kind: str = "") -> None:
        self.names, self.start, self.kind = names, start, kind

    def __len__(self) -> int:
        return len(self.names)

    def source_name(self, index: int) -> str:
        return f"img_{self.names[index]}{self.kind}"

    def source_index(self, index: int) -> int:
        return self.start + index


@pytest.mark.parametrize("kind", ["", ".png", ".JPG"])  # of a video; of a folder
@pytest.mark.parametrize(
    ("names", "start", "refused"),
    [
        (["7", "8", "9"], 7, "00009.npy, which has the number of that image"),  # of ten, from 7 on
        (["1", "2", "3"], 0, None),  # files are numbered from 0, images from 1
        (["1", "2", "3"], 1, "00003.npy, which has the number"),  # both from 0, and the run from 1
        (["a", "b", "c"], 3, "00005.npy, which has the number"),  # of ten, from 3 on
        (["4", "5", "6"], 3, "00006.npy, which has the number"),  # images from 1, files from 0
        (["14", "15", "16"], 3, "00005.npy, which has the number"),
        (["a", "b", "c"], 8, None),  # there is no file of image 10
        (["0", "1", "2"], 0, None),
        (["4.007", "4.008", "4.009"], 8, None),  # times
    ],
)
def test_files_with_the_numbers_of_the_images_are_refused(tmp_path, names, start, refused, kind):
    folder = folder_with(tmp_path, {f"{k:05d}.npy": grid(k) for k in range(10)})
    images = Images(names, start, kind)
    if refused is None:
        FileFeatures(folder, CAMERA, images)
        return FrameFiles(folder, "depth", (".npy",)).require_frames_of(images)
    with pytest.raises(InputError, match=f"depth files named by the frame .*{refused}"):
        FrameFiles(folder, "depth", (".npy",)).require_frames_of(images)
    with pytest.raises(InputError, match=f"features files named by the frame .*{refused}"):
        FileFeatures(folder, CAMERA, images)
    (folder / "frames.txt").write_text("0 0.0\n")
    FrameFiles(folder, "depth", (".npy",)).require_frames_of(images)


def test_files_counted_from_one_like_the_images_are_refused(tmp_path: Path):
    folder = folder_with(tmp_path, {f"{k}.npy": grid(k) for k in range(1, 4)})
    with pytest.raises(InputError, match=r"00002 for img_3\.png, found .*3\.npy"):
        FileFeatures(folder, CAMERA, Images(["1", "2", "3"], 0, ".png"))


def test_a_damaged_index_is_refused(tmp_path: Path):
    folder_with(tmp_path, {"0.npy": grid(1)})
    for text in ("0\n", "zero 0.5\n", "0 now\n"):
        (tmp_path / INDEX).write_text(text)
        with pytest.raises(InputError, match=r"rows of frame index and timestamp in .*frames\.txt"):
            FrameFiles(tmp_path, "features", (".npy",))


@pytest.mark.parametrize(("height", "width"), [(55, 168), (168, 55)])
def test_a_grid_that_lacks_almost_a_whole_row_of_patches_covers_its_image(
    height: int, width: int, tmp_path: Path
):
    files = {"0.npy": grid(1, height // 14, width // 14)}  # 3 of 3.93 patches, by 12
    image = torch.zeros(height, width, 3)
    assert FileFeatures(folder_with(tmp_path, files), CAMERA)(frame_of(image)).shape[2] == 6
