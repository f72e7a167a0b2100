"""The picture in a raw image: bars with captions are cut, too; of two eyes one is taken."""

import cv2
import numpy as np
import pytest

from minislam.data.picture import Glance, first_of_two, glance_at, picture_window

# Black bars


def barred(left: int, top: int, right: int, bottom: int, value: int = 90) -> np.ndarray:
    image = np.full((100, 200, 3), 20, np.uint8)  # black, as a codec leaves it
    image[top : 100 - bottom, left : 200 - right] = value
    return image


def window_of(*images: np.ndarray) -> tuple[int, int, int, int]:
    return picture_window([glance_at(image) for image in images], 200, 100)


@pytest.mark.parametrize(
    "bars, window",
    [
        ((0, 0, 0, 0), (0, 0, 200, 100)),
        ((0, 14, 0, 16), (0, 16, 200, 66)),  # letterbox; two rows beside a bar are blurred
        ((30, 0, 30, 0), (32, 0, 136, 100)),  # pillarbox
        ((10, 10, 0, 0), (12, 12, 188, 88)),
        ((0, 24, 0, 36), (0, 0, 200, 100)),  # a lamp in the dark, not a picture
        ((66, 0, 70, 0), (68, 0, 60, 100)),  # an upright film: bars that are alike
        ((65, 0, 70, 0), (0, 0, 200, 100)),
    ],
)
def test_black_bars_are_no_part_of_the_picture(bars, window: tuple[int, int, int, int]):
    assert window_of(barred(*bars)) == window


def test_what_is_dark_is_no_bar():
    assert window_of(barred(0, 14, 0, 16, value=24)) == (0, 0, 200, 100)  # all is black
    lit = barred(0, 14, 0, 16)
    lit[3, 60] = 25  # a star
    assert picture_window([], 200, 100) == (0, 0, 200, 100)  # no image could be decoded
    assert window_of(lit) == (0, 5, 200, 77)


def test_a_thing_on_black_is_not_cut_where_it_reaches_farther_in_one_image():
    turning = [barred(40 - k, 10 + 3 * k, 40 + 7 * k, 30 - 8 * k) for k in range(4)]
    assert window_of(*turning) == (0, 0, 200, 100)


def test_a_film_that_fades_in_has_its_bars_cut():
    fading = [barred(0, 14, 0, 16, value=20), barred(80, 40, 70, 30), barred(90, 45, 80, 40)]
    assert window_of(*fading, *[barred(0, 14, 0, 16)] * 2) == (0, 16, 200, 66)


def with_caption(number: int, bars: tuple[int, int, int, int] = (0, 30, 0, 30)) -> np.ndarray:
    image = barred(*bars, value=60 + number)
    image[8:16, 40:120:2] = image[84:90, 20:50] = 220
    return image


def test_a_bar_is_cut_whatever_is_written_on_it():
    window = (0, 32, 200, 36)
    assert window_of(*map(with_caption, range(4))) == window
    assert window_of(with_caption(0) * 0, *map(with_caption, range(4))) == window  # it fades in
    assert window_of(*map(with_caption, range(3))) == (0, 10, 200, 78)  # too few to tell
    logo = barred(0, 0, 20, 0)
    logo[70:90, 150:195] = 200  # it reaches into the bar
    assert window_of(*[logo] * 4) == (0, 0, 178, 100)


def test_what_changes_in_the_dark_is_no_caption():
    lamps = [with_caption(number) for number in range(4)]
    for number, image in enumerate(lamps):
        image[8:16, 40 + 20 * number :] = 0
    assert window_of(*lamps)[1] == 10


def test_a_round_picture_is_kept_whole():
    round_one = cv2.circle(np.full((100, 200, 3), 20, np.uint8), (100, 50), 48, (90, 90, 90), -1)
    assert window_of(*[round_one] * 4) == (54, 4, 93, 93)


def test_a_picture_that_grows_dark_towards_its_edge_is_kept():
    dusk = barred(0, 0, 0, 0)
    for row in range(50):
        dusk[row, 4 * row :] = 20
    assert window_of(*[dusk] * 4) == (0, 3, 200, 97)


# Two pictures in one


def scene(seed: int, width: int = 60, height: int = 60) -> np.ndarray:
    """Return coarse and fine spots (height, width, 3) uint8."""
    spots = np.random.default_rng(seed).uniform(40, 220, (12, 16, 3)).astype(np.float32)
    return (
        cv2.resize(spots, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype("u1")
    )


def first_in(*images: np.ndarray) -> tuple[int, int, int, int]:
    height, width = images[0].shape[:2]
    glances = [glance_at(image) for image in images]
    return first_of_two((0, 0, width, height), glances, width, height)


@pytest.mark.parametrize("shift", [0, 5])
def test_of_two_eyes_one_is_taken(shift: int):
    eyes = [(both[:, :80], both[:, shift : 80 + shift]) for both in map(scene, range(3), 3 * [90])]
    assert first_in(*map(np.hstack, eyes)) == (0, 0, 80, 60)
    assert first_in(*map(np.vstack, eyes)) == (0, 0, 80, 60)


def test_two_scenes_side_by_side_and_a_street_are_one_picture():
    assert first_in(np.hstack([scene(0), scene(1)])) == (0, 0, 120, 60)
    street = np.linspace(220, 60, 60)[:, None, None] + np.zeros((60, 120, 3))
    noise = np.random.default_rng(0).normal(0, 3, street.shape)
    assert first_in((street + noise).astype(np.uint8)) == (0, 0, 120, 60)
    assert first_in(np.full((60, 120, 3), 90, np.uint8)) == (0, 0, 120, 60)


def test_a_house_front_that_repeats_itself_is_one_picture():
    window = scene(0, 10, 6)
    assert first_in(np.tile(window, (10, 12, 1))) == (0, 0, 120, 60)


def test_one_image_in_which_both_are_alike_does_not_decide():
    twice, once = (Glance((np.ones(120), np.ones(60)), (like, 0.0)) for like in (0.9, 0.3))
    window = 10, 0, 100, 60  # between bars
    assert first_of_two(window, [twice, once, once], 120, 60) == window
    assert first_of_two(window, [twice, twice, once], 120, 60) == (10, 0, 50, 60)
    assert first_of_two(window, [], 120, 60) == window
    assert first_of_two((0, 0, 30, 60), [twice], 30, 60) == (0, 0, 30, 60)  # too small to halve


def test_an_upright_film_between_bars_is_one_picture():
    barred = [np.pad(scene(seed), ((0, 0), (60, 60), (0, 0))) for seed in range(3)]
    assert first_in(*barred) == (0, 0, 180, 60)
