"""The graders: right answers pass, known mistakes are named, an empty answer is "not yet"."""

import pytest
import torch
from torch import Tensor

from minislam.checks import (
    NOT_YET,
    PASSED,
    WRONG,
    Case,
    check_function,
    check_reproject,
    check_resized_intrinsics,
)
from minislam.geometry import Camera, se3_inverse, transform_points


def resized(camera: Camera, width: int, height: int) -> Tensor:
    su, sv = width / camera.width, height / camera.height
    cx, cy = (camera.cx + 0.5) * su - 0.5, (camera.cy + 0.5) * sv - 0.5
    return torch.tensor([camera.fx * su, camera.fy * sv, cx, cy], dtype=torch.float64)


def reprojected(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
    return camera.project(transform_points(pose, camera.backproject(pixels, 1 / disparities)))


def unfinished(*arguments) -> Tensor:
    raise NotImplementedError


CHECKS = [(check_resized_intrinsics, resized), (check_reproject, reprojected)]


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_solution_passes_and_an_empty_one_is_not_yet(check, solution):
    assert check(solution).status == PASSED
    assert check(unfinished).status == NOT_YET
    assert check(lambda *arguments: None).status == NOT_YET


@pytest.mark.parametrize(("check", "solution"), CHECKS)
def test_a_flipped_sign_or_one_percent_is_wrong_and_the_sentence_has_the_number(check, solution):
    for wrong in (lambda *a: -solution(*a), lambda *a: 1.01 * solution(*a)):
        verdict = check(wrong)
        assert verdict.status == WRONG and ", expected " in verdict.sentence
        assert repr(verdict).startswith("Wrong: for ")


def test_known_mistakes_are_named():
    verdict = check_resized_intrinsics(lambda c, w, h: torch.tensor(
        [c.fx * w / c.width, c.fy * h / c.height, c.cx * w / c.width, c.cy * h / c.height]
    ))  # fmt: skip
    assert "the image starts at -0.5" in verdict.sentence
    assert "for twice the size element [2] is 82.6, expected 83.1" in verdict.sentence
    inverse = check_reproject(lambda p, d, c, pose: reprojected(p, d, c, se3_inverse(pose)))
    assert "inverse motion" in inverse.sentence
    depth = check_reproject(lambda p, d, c, pose: reprojected(p, 1 / d, c, pose))
    assert "depth = 1 / disparity" in depth.sentence


def test_shapes_types_nan_and_exceptions_are_answered_in_words():
    cases = [Case((torch.ones(3),), "three ones")]

    def check(student) -> str:
        return check_function(student, lambda x: x, cases).sentence

    assert "the shape is (2,), expected (3,)" in check(lambda x: x[:2])
    assert "returns a str" in check(lambda x: "three")
    assert "element [0] is nan, expected 1" in check(lambda x: x * float("nan"))
    assert "stops with ZeroDivisionError" in check(lambda x: 1 / 0)
