"""Images that are prepared once."""

import tempfile

import numpy as np

from minislam.data.preparation import KeptImages


def image(number: int) -> np.ndarray:
    return np.full((4, 5, 3), number, np.uint8) + np.arange(3, dtype=np.uint8)


def test_each_image_is_prepared_once_and_comes_back_in_any_order():
    kept, prepared = KeptImages(), []

    def prepare(number: int) -> np.ndarray:
        prepared.append(number)
        return image(number)

    for number in (7, 0, 3, 0, 7, 3, 3):
        found = kept.get(number, lambda number=number: prepare(number))
        np.testing.assert_array_equal(found, image(number))
        found[:] = 0  # what is returned is the caller's
    assert prepared == [7, 0, 3]


def test_a_full_disk_costs_time_only(monkeypatch):
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    kept = KeptImages()
    for _ in range(2):
        np.testing.assert_array_equal(kept.get(1, lambda: image(1)), image(1))


def test_an_image_that_cannot_be_prepared_is_not_kept():
    kept = KeptImages()
    kept.get(0, lambda: image(0))
    for _ in range(2):
        try:
            kept.get(1, lambda: 1 / 0)
        except ZeroDivisionError:
            pass
    np.testing.assert_array_equal(kept.get(1, lambda: image(1)), image(1))
    np.testing.assert_array_equal(kept.get(0, lambda: image(9)), image(0))
