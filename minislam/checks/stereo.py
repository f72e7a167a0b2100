"""Exercises of notebook 07b."""

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.checks.cases import Case, doubles, drawn, normals
from minislam.checks.grading import Function, Verdict, check_function
from minislam.geometry import Camera, se3_exp, se3_inverse
from minislam.stereo.sweep import plane_homographies


def check_plane_homography(student: Function) -> Verdict:
    """Check (K (3, 3), T_other_this (4, 4), inverse depth q) -> H(q) (3, 3)."""

    def reference(K: Tensor, T: Tensor, q: float) -> Tensor:
        fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        camera = Camera(fx, fy, cx, cy, 320, 240)
        return torch.from_numpy(plane_homographies(camera, T.numpy(), np.array([q]))[0])

    def other_axis(K: Tensor, T: Tensor, q: float) -> Tensor:
        motion = T[:3, :3].clone()
        motion[2] += q * T[:3, 3]
        return K @ motion @ torch.linalg.inv(K)

    def draw(seed: int) -> Case:
        q = 0.3 + 0.1 * (seed % 9)
        return Case((K, se3_exp(0.2 * normals(seed, 6)), q), f"q = {q}")

    K = doubles([60, 0, 33], [0, 66, 19], [0, 0, 1])
    T = se3_exp(doubles(0.3, -0.1, 0.2, 0.1, -0.2, 0.05))
    cases = [
        Case((K, T, 0.0), "a plane at infinity"),
        Case((K, T, 0.5), "a plane two units away"),
        Case((K, se3_inverse(T), 0.8), "a camera that moves the other way"),
        *drawn(draw),
    ]
    mistakes = [
        (lambda K, T, q: reference(K, se3_inverse(T), q), "This is the way back."),
        (lambda K, T, q: reference(K, T, q and 1 / q), "q is an inverse depth: t times q."),
        (lambda K, *a: K.inverse() @ reference(K, *a) @ K, "H needs K on both sides: for pixels."),
        (lambda K, T, q: reference(K, T, -q), "The sign of the translation is the other one."),
        (lambda K, T, q: reference(K, T, 0.0), "The translation is missing."),
        (other_axis, "t stands in the last column, t n^T, not in the last row."),
        (lambda K, T, q: reference(K, T, q) @ K @ K, "The last factor is K^-1, not K."),
    ]
    return check_function(student, reference, cases, 1e-9, mistakes)


def check_plane_cost(student: Function) -> Verdict:
    """Check (grey image (h, w), V warped images (V, h, w)) -> cost of one plane (h, w).

    A negative value is outside of its image. Of each view the absolute difference is averaged over
    5x5 px; the cost is the mean of the better half of the views that see the pixel, 1 without any.
    """

    def reference(gray: np.ndarray, warped: np.ndarray, flaw: str = "") -> np.ndarray:
        seen = (warped >= 0) | (flaw == "outside")
        difference = np.where(seen, np.abs(warped.clip(0) - gray), 0)
        window = (1, 1) if flaw == "pixel" else (5, 5)
        blurred = [cv2.blur(picture, window) for picture in difference]
        ordered = np.sort(np.where(seen, blurred, np.inf), 0)[:: -1 if flaw == "worse" else 1]
        number = seen.sum(0)
        half = (number + (flaw != "down")) // 2
        taken = np.maximum(number if flaw == "every" else half, 1)
        inside = (np.arange(len(warped))[:, None, None] < taken) & np.isfinite(ordered)
        total = np.where(inside, ordered, 0).sum(0)
        return np.where(number > 0, total / taken, float(flaw != "unseen"))

    def pictures(seed: int) -> np.ndarray:
        return np.random.default_rng(seed).random((9, 12, 15))

    def partly(seed: int) -> Case:
        gray, unseen, warped = np.split(pictures(seed), [1, 5])
        views = np.where(unseen < 0.5, -1.0, warped)
        return Case((gray[0], views), "views that do not see every pixel")

    gray, *warped = pictures(0)
    cases = [
        Case((gray, gray[None] + 0.1), "one view, everywhere a little brighter"),
        Case((gray, np.stack(warped[:4])), "four views"),
        Case((gray, np.stack(warped[:3])), "three views, of which two are the better half"),
        *drawn(partly),
    ]
    mistakes = [
        ("every", "Only the better half of the views is averaged."),
        ("worse", "This is the worse half."),
        ("pixel", "Average over the 5x5 px around the pixel."),
        ("down", "Of three views two are the half: round up."),
        ("unseen", "A pixel that no view sees costs 1."),
        ("outside", "A negative value is outside of the image: that view does not count there."),
    ]
    return check_function(student, reference, cases, 1e-6, mistakes)
