"""What lies beside a recording: which of it is truth, and the truth at the working size."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.images import encode_png
from minislam.data.options import InputOptions
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.data.tum import read_tum_folder
from minislam.errors import InputError
from minislam.priors.files import FrameFiles
from tests.recordings import picture, save, tum_folder, video

# Known answers


def test_the_truth_of_a_frame_is_that_of_its_image_in_the_recording(tmp_path: Path):
    truth = open_sequence(str(tum_folder(tmp_path)), InputOptions(start=1)).ground_truth
    assert truth.moving_mask(1)[:, :24].all() and not truth.moving_mask(1)[:, 24:].any()
    np.testing.assert_allclose(truth.depth(1), np.float32(5002 / 5000))
    np.testing.assert_allclose(truth.static_image(1), picture(20) / 255, atol=1e-6)
    views = truth.novel_views()
    assert views[1][0][1, 3] == 1 and views[1][1].shape == (32, 48, 3)


def test_the_truth_has_the_working_size(tmp_path: Path):
    truth = open_sequence(str(tum_folder(tmp_path)), InputOptions(size=(20, 17))).ground_truth
    assert truth.moving_mask(0).shape == truth.depth(0).shape == (17, 20)
    assert truth.static_image(0).shape == truth.novel_views()[0][1].shape == (17, 20, 3)


# Degenerate input


def test_depth_alone_is_an_input_and_no_truth(tmp_path: Path):
    folder = tum_folder(tmp_path)
    assert open_sequence(str(folder)).ground_truth is not None
    (folder / "groundtruth.txt").unlink()
    for name in ("masks", "static", "novel"):
        (folder / name).rename(tmp_path / f"without_{name}")
    assert read_tum_folder(folder).depth_paths
    assert open_sequence(str(folder)).ground_truth is None


# Masks from files


def photos(folder: Path, *names: str) -> str:
    folder.mkdir()
    for number, name in enumerate(names):
        (folder / f"{name}.png").write_bytes(encode_png(picture(number)))
    return str(folder)


def masks(folder: Path, *names: str, value: int = 255) -> str:
    """Write masks of which the k-th covers the first k + 1 columns."""
    folder.mkdir()
    for number, name in enumerate(names):
        mask = np.zeros(picture(0).shape[:2], np.uint8)
        mask[:, : number + 1] = value
        (folder / f"{name}.png").write_bytes(encode_png(mask))
    return f"files:{folder}"


def columns(sequence: RecordedSequence) -> list[int]:
    return [int(sequence.given_mask(k).all(0).sum()) for k in range(len(sequence))]


def test_masks_are_found_by_the_names_of_the_images_or_by_their_numbers(tmp_path: Path):
    source = photos(tmp_path / "photos", "b10", "b9", "b11")  # in natural order b9, b10, b11
    named = masks(tmp_path / "named", "b9", "b10", "b11", "other")
    sequence = open_sequence(source, InputOptions(masks=named))
    assert columns(sequence) == [1, 2, 3] and sequence.ground_truth is None
    assert f"masks from {named}" in sequence.description
    numbered = masks(tmp_path / "numbered", "00000", "00001", "2")
    assert columns(open_sequence(source, InputOptions(masks=numbered))) == [1, 2, 3]
    later = InputOptions(masks=numbered, start=1, stride=1)
    assert columns(open_sequence(source, later)) == [2, 3]  # the number is that in the source
    assert [open_sequence(source, later).source_index(k) for k in range(2)] == [1, 2]
    # Names win: these numbers are names.
    source = photos(tmp_path / "stamps", "2", "3", "4")
    stamps = masks(tmp_path / "of_stamps", "0", "1", "2", "3", "4")
    assert columns(open_sequence(source, InputOptions(masks=stamps))) == [3, 4, 5]


def test_names_of_masks_may_be_written_with_accents_apart(tmp_path: Path):
    source = photos(tmp_path / "named", "\u00e91", "\u00e92")
    apart = masks(tmp_path / "masks", "e\u03011", "e\u03012")
    assert columns(open_sequence(source, InputOptions(masks=apart))) == [1, 2]


def test_masks_of_files_come_before_those_of_the_recording_and_are_no_truth(tmp_path: Path):
    folder = tum_folder(tmp_path)
    given = masks(tmp_path / "given", *(p.stem for p in sorted((folder / "rgb").iterdir())))
    sequence = open_sequence(str(folder), InputOptions(masks=given))
    assert columns(sequence)[:2] == [1, 2]
    assert sequence.ground_truth.moving_mask(1)[:, :24].all()
    without = open_sequence(str(folder), InputOptions())
    assert (without.given_mask(1) == without.ground_truth.moving_mask(1)).all()


def test_masks_of_a_video_are_found_by_number(tmp_path: Path):
    walk = video(tmp_path / "walk.mp4", 4, (48, 32))
    given = masks(tmp_path / "given", "0000", "0001", "0002", "0003")
    sequence = open_sequence(str(walk), InputOptions(masks=given, start=1, stride=2))
    assert columns(sequence) == [2, 4]


def test_masks_counted_from_one_are_refused(tmp_path: Path):
    walk = str(video(tmp_path / "walk.mp4", 4, (48, 32)))
    given = masks(tmp_path / "given", "1", "2", "3", "4")
    with pytest.raises(InputError, match=r"counted from 0 in .*, found 1 to 4; count them anew"):
        open_sequence(walk, InputOptions(masks=given, start=1))
    later = masks(tmp_path / "later", "2", "3", "4")  # of some images
    assert columns(open_sequence(walk, InputOptions(masks=later, start=2))) == [1, 2]


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (lambda folder: str(folder), "expected --masks files:FOLDER .*; write files:.*wrong_masks"),
        (lambda folder: f"files:{folder}/none", "that exists, found no folder at .*none; check it"),
        (lambda folder: "nowhere", "that exists, found no folder at nowhere; check it"),
        (lambda folder: masks(folder / "few", "a"), r"found none for 2 of 3, such as .*b\.png"),
        (lambda folder: masks(folder / "no"), "found none for 3 of 3"),
        (lambda folder: masks(folder / "one", "a", "b", "c", value=1),
         r"a mask of 0 and 255, found 1 as the largest value in .*a\.png"),
    ],
)  # fmt: skip
def test_wrong_masks_are_one_sentence(given, sentence: str, tmp_path: Path):
    source = photos(tmp_path / "photos", "a", "b", "c")
    with pytest.raises(InputError, match=sentence):
        open_sequence(source, InputOptions(masks=given(tmp_path))).given_mask(0)


def test_masks_are_looked_for_before_a_clip_is_rendered(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("MINISLAM_CACHE", str(tmp_path))
    with pytest.raises(InputError, match="found no folder at nowhere"):
        open_sequence("synth:ball", InputOptions(masks="files:nowhere"))
    assert not list(tmp_path.iterdir())


def test_a_mask_of_another_size_is_refused(tmp_path: Path):
    source = photos(tmp_path / "photos", "a", "b")
    given = masks(tmp_path / "given", "a", "b")
    (tmp_path / "given/a.png").write_bytes(encode_png(np.zeros((9, 9), np.uint8)))
    with pytest.raises(InputError, match=r"of one size, .* found 9x9 in .*a\.png"):
        open_sequence(source, InputOptions(masks=given)).given_mask(0)


# Order

LISTINGS = "iterdir", "glob", "rglob"


def listed(monkeypatch: pytest.MonkeyPatch, backwards: bool) -> None:
    """Let the system list the files of a folder in the order of their names, or the other way."""
    for name in LISTINGS:
        original = getattr(Path, name)

        def ordered(path: Path, *pattern: str, original=original) -> list[Path]:
            return sorted(original(path, *pattern), reverse=backwards)

        monkeypatch.setattr(Path, name, ordered)


def test_the_order_in_which_the_system_lists_files_changes_nothing(tmp_path: Path, monkeypatch):
    source = photos(tmp_path / "photos", "b10", "b9", "b11")
    given = masks(tmp_path / "given", "b9", "b10", "b11")
    folder = tum_folder(tmp_path / "tum")
    for name, camera in (("README.md", "freiburg2"), ("README.txt", "freiburg1")):
        (folder / name).write_text(camera)
    (folder / "calibration.txt").unlink()
    for path in (folder / "rgb").iterdir():  # of the shape that the named cameras have
        save(path, picture(3, 64, 48))
    (tmp_path / "depth").mkdir()
    for value, name in enumerate(("0.npz", "0.npy", "1.npy")):
        (tmp_path / "depth" / name).write_bytes(bytes(value))
    found = []
    for backwards in (False, True):
        with monkeypatch.context() as patch:
            listed(patch, backwards)
            sequence = open_sequence(source, InputOptions(masks=given))
            frames = [frame.pixels.sum().item() for frame in sequence]
            named = read_tum_folder(folder).calibration
            files = FrameFiles(tmp_path / "depth", "depth", (".npy", ".npz"))
            found.append((frames, columns(sequence), named, files.paths[min(files.paths)]))
    assert found[0] == found[1] and found[0][1] == [1, 2, 3] and found[0][2] is not None
