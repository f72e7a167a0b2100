"""Right and wrong answers to the exercises of notebook 07."""

import numpy as np
import pytest
import torch

from minislam.checks import check_deformed_means, check_sampling
from minislam.geometry import se3_inverse, transform_points
from tests.helpers import assert_variants


def sampling(count, window, share):
    if len(window) > share * count:
        return [1 / count] * count
    others = (1 - share) / (count - len(window))
    return [share / len(window) if k in window else others for k in range(count)]


def with_numpy(count, window, share):
    p = np.full(count, (1 - share) / max(count - len(window), 1), dtype=np.float32)
    p[window] = share / len(window)
    return p if len(window) <= share * count else np.full(count, 1 / count, np.float32)


def unguarded(count, window, share):
    others = (1 - share) / max(count - len(window), 1)
    return [share / len(window) if k in window else others for k in range(count)]


def undivided(count, window, share):
    return [share if k in window else 1 - share for k in range(count)]


@pytest.mark.ex07_1
def test_sampling():
    right = {"list": sampling, "numpy": with_numpy}
    wrong = {
        "unguarded": unguarded,
        "uniform": lambda n, w, s: [1 / n] * n,
        "the window alone": lambda n, w, s: [(k in w) / len(w) for k in range(n)],
        "share exchanged": lambda n, w, s: unguarded(n, w, 1 - s),
        "one half": lambda n, w, s: sampling(n, w, 0.5),
        "not divided": undivided,
        "normalised afterwards": lambda n, w, s: (
            [p / sum(undivided(n, w, s)) for p in undivided(n, w, s)]
        ),
        "the newest": lambda n, w, s: sampling(n, list(range(n))[-len(w) :], s),
        "guard at one half": lambda n, w, s: (
            [1 / n] * n if len(w) > 0.5 * n else unguarded(n, w, s)
        ),
        "of the window only": lambda n, w, s: [s / len(w)] * len(w),
    }
    assert_variants(check_sampling, right, wrong)


def by(motion):
    def answer(means, rows, old, new):
        return transform_points(motion(old, new)[rows], means[:, None])[:, 0]

    return answer


def one_by_one(means, rows, old, new):
    moved = []
    for mean, row in zip(means, rows.tolist(), strict=True):
        in_camera = old[row] @ torch.cat([mean, torch.ones(1).to(mean)])
        moved.append(torch.linalg.solve(new[row], in_camera)[:3].numpy())
    return moved


def only(part):
    def motion(old, new):
        whole = se3_inverse(new) @ old
        partial = torch.eye(4).to(whole).repeat(len(whole), 1, 1)
        partial[:, :3, part] = whole[:, :3, part]
        return partial

    return by(motion)


@pytest.mark.ex07_2
def test_deformed_means():
    whole = by(lambda old, new: se3_inverse(new) @ old)
    right = {"batch": whole, "loop": one_by_one}
    wrong = {
        "backwards": lambda x, r, a, b: whole(x, r, b, a),
        "of camera points": by(lambda old, new: new @ se3_inverse(old)),
        "the first keyframe": lambda x, r, a, b: whole(x, 0 * r, a, b),
        "unmoved": lambda x, r, a, b: x,
        "in the camera": by(lambda old, new: old),
        "no translation": only(slice(0, 3)),
        "no rotation": only(slice(3, 4)),
        "moved twice": lambda x, r, a, b: whole(whole(x, r, a, b), r, a, b),
        "homogeneous": lambda x, r, a, b: torch.cat([whole(x, r, a, b), x[:, :1]], 1),
    }
    assert_variants(check_deformed_means, right, wrong)
