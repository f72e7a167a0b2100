"""Images whose sizes differ: most count, similar ones are resized, the others left out."""

from pathlib import Path

import numpy as np
import pytest

from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from tests.recordings import picture, save


def test_images_of_another_size_are_left_out(tmp_path: Path):
    save(tmp_path / "1.png", picture(1))
    save(tmp_path / "2.png", picture(1, 32, 48))
    save(tmp_path / "3.png", picture(1))
    sequence = open_sequence(str(tmp_path))
    assert [frame.timestamp for frame in sequence] == pytest.approx([1 / 30, 3 / 30])
    assert sequence.unread == [(pytest.approx(2 / 30), "2.png is 32x48 px, others are 48x32")]
    assert "1 of 3 images are left out because of their size" in sequence.warnings[-1]
    sequence = open_sequence(str(tmp_path), InputOptions(stride=2))  # without the odd one
    assert len(sequence) == 2 and not sequence.unread


def test_the_size_of_most_images_counts_not_that_of_the_first(tmp_path: Path):
    save(tmp_path / "1.png", picture(1, 32, 48))
    for name in "23":
        save(tmp_path / f"{name}.png", picture(1))
    sequence = open_sequence(str(tmp_path))
    assert len(sequence) == 2 and len(sequence.unread) == 1


def test_sizes_and_not_options_are_blamed_where_they_leave_less_than_two_images(tmp_path: Path):
    for number, size in enumerate(((48, 32), (32, 48), (48, 48))):
        save(tmp_path / f"{number}.png", picture(1, *size))
    left_out = "as 2 of 3 images are left out because of their size, such as 1.png is 32x48 px"
    with pytest.raises(InputError, match=rf"found 1 among 3 images of \w+ {left_out}, others"):
        open_sequence(str(tmp_path))
    with pytest.raises(InputError, match=r"0 among 3 images of \w+ after --start, --stride"):
        open_sequence(str(tmp_path), InputOptions(start=2))


def test_a_size_of_zero_is_no_size(tmp_path: Path):
    for name in "12":
        save(tmp_path / f"{name}.png", picture(1))
        content = bytearray((tmp_path / f"{name}.png").read_bytes())
        content[16:24] = bytes(8)  # width and height
        (tmp_path / f"{name}.png").write_bytes(content)
    with pytest.raises(InputError, match=r"1\.png"):
        open_sequence(str(tmp_path))


def test_images_of_nearly_the_usual_size_are_resized(tmp_path: Path):
    for name, size in (("1", (100, 66)), ("2", (99, 65)), ("3", (100, 66)), ("4", (100, 64))):
        save(tmp_path / f"{name}.png", picture(1, *size))
    sequence = open_sequence(str(tmp_path), InputOptions(size=(100, 66)))
    assert len(sequence) == 3  # the fourth differs by 3 % in one side, and is left out
    assert {frame.image.shape for frame in sequence} == {(66, 100, 3)}
    odd, resized = sequence.warnings[-2:]
    assert "such as 4.png is 100x64 px, others are 100x66; crop, turn or" in odd
    assert resized == (
        "1 of 4 images are resized to the size of most, such as 2.png is 99x65 px, others are "
        "100x66"
    )
    assert "resized" not in str(open_sequence(str(tmp_path), InputOptions(stride=2)).warnings)
    for name, size in (("1", (100, 66)), ("2", (99, 65)), ("3", (100, 66))):
        mask = np.zeros(size[::-1], np.uint8)
        mask[:, : size[0] // 2] = 255
        save(tmp_path / f"masks/{name}.png", mask)
    given = InputOptions(size=(100, 66), masks=f"files:{tmp_path / 'masks'}")
    masks = [open_sequence(str(tmp_path), given).given_mask(index) for index in range(3)]
    assert all(abs(mask[:, :50].mean() - 1) + mask[:, 50:].mean() < 0.03 for mask in masks)


def test_the_depth_of_a_resized_image_stays_metres(tmp_path: Path):
    rows = {"rgb": "", "depth": ""}
    for number in range(3):
        width = 48 if number != 1 else 49
        images = {"rgb": picture(number, width, 32)}
        images["depth"] = np.full((32, width), 2500 * (number + 1), np.uint16)
        for kind, image in images.items():
            save(tmp_path / f"{kind}/{number}.png", image)
            rows[kind] += f"{0.1 * number} {kind}/{number}.png\n"
    for kind, text in rows.items():
        (tmp_path / f"{kind}.txt").write_text(text)
    sequence = open_sequence(str(tmp_path))
    for number in range(3):
        depth = sequence.sensor_depth(number)
        assert depth is not None and depth.dtype == np.float32
        assert (depth == 0.5 * (number + 1)).all()
