"""How well the uncertainty separates dynamic objects from the static scene."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import rankdata

from minislam.errors import InputError


def auroc(
    scores: ArrayLike,  # any shape, for instance beta; larger means "moving"
    mask: ArrayLike,  # the same shape, True on dynamic objects
) -> float:  # 1: perfect, 0.5: chance, 0: inverted
    """Return the area under the ROC curve, from ranks (Mann and Whitney's U).

    It is the probability that a random moving pixel scores higher than a random static one;
    equal scores count half. No threshold is needed.
    """
    scores = np.asarray(scores, dtype=np.float64).ravel()
    mask = np.asarray(mask, dtype=bool).ravel()
    positives, negatives = int(mask.sum()), int((~mask).sum())
    if scores.shape != mask.shape or positives == 0 or negatives == 0:
        raise InputError(
            f"expected one score per pixel and pixels of both kinds, found {scores.size} scores, "
            f"{positives} moving and {negatives} static pixels; choose frames with dynamic objects"
        )
    if not np.isfinite(scores).all():
        raise InputError("expected finite scores, found NaN or infinity; check the uncertainty")
    u = rankdata(scores)[mask].sum() - positives * (positives + 1) / 2
    return float(u / (positives * negatives))
