"""Answers to the exercises of the notebooks: each check takes the student's function.

A check calls the function with a few inputs, compares with the package, and answers in a sentence
that names the first number that is wrong. It never raises, so a notebook with open exercises
still runs from top to bottom.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import Camera, se3_exp, se3_inverse, transform_points

PASSED, NOT_YET, WRONG = "passed", "not yet", "wrong"


@dataclass(frozen=True)
class Verdict:
    """What a check found; a notebook shows the sentence."""

    status: str  # PASSED, NOT_YET or WRONG
    sentence: str

    def __repr__(self) -> str:
        return f"{self.status.capitalize()}: {self.sentence}"


@dataclass(frozen=True)
class Case:
    """One input of a check, and what it stands for."""

    arguments: tuple[Any, ...]
    description: str  # completes "for ..."


def check_function(
    student: Callable[..., Tensor],
    reference: Callable[..., Tensor],
    cases: list[Case],
    tolerance: float = 1e-6,  # relative to the largest expected number, at least 1
    hints: list[tuple[Callable[..., Tensor], str]] | None = None,  # (known mistake, what it is)
) -> Verdict:
    """Compare a student's function with the reference on all cases, up to the first difference."""
    for case in cases:
        expected = torch.as_tensor(reference(*case.arguments))
        try:
            answer = student(*case.arguments)
        except NotImplementedError:
            return Verdict(NOT_YET, "write the body of the function and run both cells again.")
        except Exception as error:  # any mistake of the student's is an answer, not a crash
            message = f"for {case.description} it stops with {type(error).__name__}: {error}."
            return Verdict(WRONG, message)
        if answer is None:
            return Verdict(NOT_YET, f"for {case.description} the function returns nothing.")
        found = _difference(answer, expected, tolerance)
        if found:
            hint = _recognise(answer, case, hints or [], tolerance)
            return Verdict(WRONG, f"for {case.description} {found}.{hint}")
    return Verdict(PASSED, f"{len(cases)} of {len(cases)} cases agree with the package.")


def _difference(answer: Any, expected: Tensor, tolerance: float) -> str:
    """Return "" if the answer is right, else what is wrong with it."""
    try:
        answer = torch.as_tensor(answer).to(expected.dtype)
    except (TypeError, ValueError, RuntimeError):
        return f"it returns a {type(answer).__name__}, expected a tensor"
    if answer.shape != expected.shape:
        return f"the shape is {tuple(answer.shape)}, expected {tuple(expected.shape)}"
    allowed = tolerance * max(1.0, float(expected.abs().max()))
    wrong = ~((answer - expected).abs() <= allowed)  # the negation also catches NaN
    if not wrong.any():
        return ""
    index = tuple(wrong.nonzero()[0].tolist())
    where = f"element {list(index)}" if index else "the value"
    return f"{where} is {float(answer[index]):.6g}, expected {float(expected[index]):.6g}"


def _recognise(
    answer: Any, case: Case, hints: list[tuple[Callable[..., Tensor], str]], tolerance: float
) -> str:
    """Return the hint whose known mistake gives the student's answer, or ""."""
    for mistake, hint in hints:
        if not _difference(answer, torch.as_tensor(mistake(*case.arguments)), tolerance):
            return " " + hint
    return ""


# Notebook 01


def check_resized_intrinsics(student: Callable[[Camera, int, int], Tensor]) -> Verdict:
    """Check (camera, width, height) -> (fx, fy, cx, cy) of the resized image."""
    camera = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)

    def reference(camera: Camera, width: int, height: int) -> Tensor:
        resized = camera.resized(width, height)
        return torch.tensor([resized.fx, resized.fy, resized.cx, resized.cy], dtype=torch.float64)

    def only_scaled(camera: Camera, width: int, height: int) -> Tensor:
        su, sv = width / camera.width, height / camera.height
        values = [camera.fx * su, camera.fy * sv, camera.cx * su, camera.cy * sv]
        return torch.tensor(values, dtype=torch.float64)

    cases = [
        Case((camera, 101, 53), "the same size"),
        Case((camera, 202, 106), "twice the size"),
        Case((camera, 33, 26), "33 x 26 pixels"),
    ]
    hint = "This is cx * s: the image starts at -0.5, so scale cx + 0.5 and take 0.5 off again."
    return check_function(student, reference, cases, hints=[(only_scaled, hint)])


def check_reproject(student: Callable[[Tensor, Tensor, Camera, Tensor], Tensor]) -> Verdict:
    """Check (pixels, disparities, camera, T_target_source) -> pixels in the target view."""
    camera = Camera(70.0, 90.0, 41.3, 22.8, 101, 53)
    pixels = torch.tensor([[0.0, 0.0], [100.0, 52.0], [60.5, 10.25]], dtype=torch.float64)
    disparities = torch.tensor([0.5, 0.25, 1.0], dtype=torch.float64)

    def reference(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        points = camera.backproject(pixels, 1 / disparities)
        return camera.project(transform_points(pose, points))

    def inverted_pose(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor) -> Tensor:
        return reference(pixels, disparities, camera, se3_inverse(pose))

    def disparity_as_depth(pixels: Tensor, disparities: Tensor, camera: Camera, pose: Tensor):
        return reference(pixels, 1 / disparities, camera, pose)

    def motion(*xi: float) -> Tensor:
        return se3_exp(torch.tensor(xi, dtype=torch.float64))

    cases = [
        Case((pixels, disparities, camera, motion(0, 0, 0, 0, 0, 0)), "a camera that stands still"),
        Case((pixels, disparities, camera, motion(0.2, 0, 0, 0, 0, 0)), "a step of 0.2"),
        Case((pixels, disparities, camera, motion(0.1, -0.2, 0.3, 0.1, 0.2, -0.1)), "any motion"),
    ]
    hints = [
        (inverted_pose, "This is the inverse motion: T_target_source takes points to the target."),
        (disparity_as_depth, "This takes the disparity for the depth: depth = 1 / disparity."),
    ]
    return check_function(student, reference, cases, hints=hints)
