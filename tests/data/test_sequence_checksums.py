"""Checksums of what was read, by which a resumed run knows its input again."""

from pathlib import Path

import pytest

from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from tests.recordings import picture, save, tum_folder


def test_every_image_is_named_and_every_image_that_was_read_has_a_checksum(tmp_path: Path):
    folder = tum_folder(tmp_path / "desk")
    sequence = open_sequence(str(folder))
    names = [*sorted(folder.glob("rgb/*.png")), *sorted(folder.glob("masks/*.png"))]
    assert sequence.files == names
    before = dict(sequence.checksums)
    sequence.frame(3), sequence.frame(1)
    assert set(sequence.checksums) - set(before) == {1, 3}
    assert len(set(sequence.checksums.values())) == len(sequence.checksums)


@pytest.mark.parametrize(
    ("changed", "k1"), [("rgb", None), ("masks", None), ("depth", None), ("none", -0.1)]
)
def test_checksums_differ_for_another_image_mask_depth_or_lens(
    tmp_path: Path, changed: str, k1: float | None
):
    folder = tum_folder(tmp_path / "desk")
    masks, sums = f"files:{folder / 'masks'}", []
    for lens in (None, k1):
        sequence = open_sequence(str(folder), InputOptions(masks=masks, k1=lens))
        assert len(list(sequence)) == 6
        sums.append(sequence.checksums)
        for path in folder.glob(f"{changed}/100.1*.png"):
            save(path, picture(9)[..., 0] if changed != "rgb" else picture(9))
    same = [index for index in range(6) if sums[0][index] == sums[1][index]]
    assert same == ([] if k1 else [0, 2, 3, 4, 5])
