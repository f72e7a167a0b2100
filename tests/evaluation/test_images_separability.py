"""AUROC: hand-counted pairs, invariances, ties."""

import numpy as np
import pytest

from minislam.errors import InputError
from minislam.evaluation.images import auroc

# Known answers


def test_counted_by_hand():
    # Moving 3, 1; static 2, 0, 1. Pairs won: 3 beats all three; 1 beats 0 and ties with 1.
    assert auroc([3, 1, 2, 0, 1], [1, 1, 0, 0, 0]) == pytest.approx((3 + 1.5) / 6)


@pytest.mark.parametrize("scores, expected", [([1, 2, 3, 4], 1), ([4, 3, 2, 1], 0), ([5] * 4, 0.5)])
def test_perfect_inverted_and_blind(scores: list[float], expected: float):
    assert auroc(scores, [False, False, True, True]) == expected


# Identities


def test_it_is_the_share_of_pairs_and_knows_only_the_order():
    source = np.random.default_rng(0)
    scores, mask = source.integers(0, 9, (8, 10)).astype(float), source.random((8, 10)) < 0.3
    moving, static = scores[mask][:, None], scores[~mask][None]
    share = ((moving > static) + 0.5 * (moving == static)).mean()
    assert auroc(scores, mask) == pytest.approx(share, abs=1e-12)
    assert auroc(np.exp(scores), mask) == auroc(scores, mask)
    assert auroc(-scores, mask) == pytest.approx(1 - auroc(scores, mask), abs=1e-12)


# Errors


@pytest.mark.parametrize("mask", [[0, 0, 0], [1, 1, 1], [1, 0]])
def test_one_kind_alone_has_no_answer(mask: list[int]):
    with pytest.raises(InputError, match="both kinds"):
        auroc([1.0, 2.0, 3.0], mask)


def test_nan_is_refused():
    with pytest.raises(InputError, match="finite"):
        auroc([1.0, np.nan], [0, 1])
