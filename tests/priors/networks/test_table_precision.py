"""Networks in half precision: near the full answer, and only the large parts of them.

On a CPU torch computes bfloat16 as a GPU does, only slowly; fp16 needs a GPU.
"""

from dataclasses import fields

import pytest
import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.priors.networks import droid_network
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.droid import DroidFlow
from minislam.priors.networks.metric3d import Metric3DDepth
from minislam.priors.networks.vit import DinoFeatures
from minislam.records import Frame
from minislam.state.stateful import Tree
from tests.checkpoint_files import calm_droid, tiny_fit3d
from tests.priors.networks import rebuilt

pytestmark = pytest.mark.slow

HALF = torch.bfloat16


def in_precision(tensors: dict[str, Tensor], precision: torch.dtype) -> Weights:
    weights = Weights({n.removeprefix("module."): t for n, t in tensors.items()}, "x.pth")
    weights.precision = precision
    return weights


def relative_error(found: Tensor, expected: Tensor) -> float:
    assert found.dtype == expected.dtype == torch.float32
    return float((found - expected).norm() / expected.norm())


def test_features_are_near_those_of_full_precision():
    frame, files = Frame(0, 0.0, rebuilt.image(56, 70)), tiny_fit3d()
    full, half = (DinoFeatures(in_precision(files, p))(frame) for p in (torch.float32, HALF))
    assert 1e-4 < relative_error(half, full) < 0.03


def test_depth_is_near_that_of_full_precision():
    camera, frame = Camera(60, 60, 34.5, 27.5, 70, 56), Frame(0, 0.0, rebuilt.image(56, 70))
    tensors = rebuilt.tensors_of(rebuilt.shapes_of("metric3d_vit_small"))
    full, half = (
        Metric3DDepth(in_precision(tensors, p), (56, 84))(frame, camera)
        for p in (torch.float32, HALF)
    )
    assert 0 < relative_error(half, full) < 0.03


def test_flow_is_near_that_of_full_precision_and_its_state_can_be_saved():
    found = []
    for precision in (torch.float32, HALF):
        flow = DroidFlow(in_precision(calm_droid(), precision))
        for index in range(2):
            flow.add_frame(index, rebuilt.image(64, 72 + 8 * index)[:, :72])
        still = Camera(50, 50, 36, 32, 72, 64).pixel_grid(8).flatten(0, 1).T[None]
        found.append((flow.match([0], [1], still), still))
        _, of_chain = flow.start_chain(rebuilt.image(64, 72)).advance(rebuilt.image(64, 72))
        assert of_chain.targets.dtype == torch.float32
        assert dtypes(flow.saved_state()) <= {torch.float32}
    (full, still), (half, _) = found
    assert float((half.targets - full.targets).norm()) < 0.1 * float((full.targets - still).norm())
    for name in (entry.name for entry in fields(full)):
        assert getattr(half, name).dtype == torch.float32
    assert (half.confidences - full.confidences).abs().max() < 0.1


def dtypes(tree: Tree) -> set[torch.dtype]:
    """Return the dtypes of all tensors in a state."""
    if isinstance(tree, Tensor):
        return {tree.dtype}
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return set().union(*map(dtypes, parts))


def test_only_layers_inside_the_network_are_in_half_precision(monkeypatch: pytest.MonkeyPatch):
    seen = []
    correlation_pyramid = droid_network.correlation_pyramid
    monkeypatch.setattr(
        "minislam.priors.networks.droid_network.correlation_pyramid",
        lambda *pair: seen.append(pair[0].dtype) or correlation_pyramid(*pair),
    )
    flow = DroidFlow(in_precision(calm_droid(), HALF))
    flow.start_chain(rebuilt.image(64, 72)).advance(rebuilt.image(64, 72))
    assert set(seen) == {HALF} and not torch.is_autocast_enabled("cpu")
