"""NaN is named where it leaves a room, but only when somebody looks for it."""

import pytest
import torch

from minislam.state.finite import check_finite


def test_only_under_debug_and_with_the_name_of_the_place(monkeypatch: pytest.MonkeyPatch):
    good, bad = torch.ones(3), torch.tensor([[1.0, torch.nan], [-torch.inf, 0.0]])
    monkeypatch.delenv("MINISLAM_DEBUG", raising=False)
    check_finite("the map", good, bad)
    monkeypatch.setenv("MINISLAM_DEBUG", "1")
    check_finite("the map", good, torch.zeros(0))
    with pytest.raises(FloatingPointError, match="in the map, found 2 of 4 that are not"):
        check_finite("the map", good, bad)
