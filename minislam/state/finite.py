"""Numbers that are none, found where they leave a room; only when a fault is looked for."""

import os

from torch import Tensor


def check_finite(name: str, *tensors: Tensor) -> None:
    """Raise FloatingPointError if a tensor has NaN or infinity, under MINISLAM_DEBUG=1 only."""
    if not os.environ.get("MINISLAM_DEBUG"):
        return
    for tensor in tensors:
        wrong = int((~tensor.isfinite()).sum())
        if wrong:
            raise FloatingPointError(
                f"expected finite numbers in {name}, found {wrong} of {tensor.numel()} that are not"
            )
