"""Priors are chosen by name; what does not fit together is refused in one sentence."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from minislam.data.sequence import open_sequence
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.choice import PriorChoice, choose_depth, choose_features, choose_flow
from minislam.priors.depth import NoDepth, SensorDepth, SimulatedDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.priors.interfaces import DepthPrior
from minislam.priors.networks.table import NetworksConfig
from tests.recordings import tum_folder

CAMERA, NETWORKS = Camera(60.0, 60.0, 39.5, 29.5, 80, 60), NetworksConfig()


class Recorded:
    """A sequence of which nothing is known but its name."""

    name = "desk"
    ground_truth = None
    with_depth = 1  # the frame of which a sensor measured the depth

    def __len__(self) -> int:
        return 2

    def sensor_depth(self, frame_index: int) -> np.ndarray | None:
        return np.ones((3, 4)) if frame_index == self.with_depth else None


def flow(**flags: str):
    return choose_flow(PriorChoice(**flags), NETWORKS)


def features(**flags: str):
    return choose_features(PriorChoice(**flags), CAMERA, NETWORKS)


def depth(**flags: str):
    return choose_depth(PriorChoice(**flags), Recorded(), 0, NETWORKS)


# Known answers


def test_priors_without_weights_are_found_by_their_names():
    assert isinstance(flow(), ClassicalFlow)
    assert isinstance(features(), ClassicalFeatures)
    assert isinstance(depth(), NoDepth) and isinstance(depth(depth="sensor"), SensorDepth)


def test_the_truth_may_be_unknown_in_the_first_frame(monkeypatch):
    monkeypatch.setattr(Recorded, "ground_truth", SimpleNamespace(depth=Recorded().sensor_depth))
    assert isinstance(depth(depth="simulated"), SimulatedDepth)
    monkeypatch.setattr(Recorded, "with_depth", None)
    with pytest.raises(InputError, match="true depth in desk for --depth simulated, found none"):
        depth(depth="simulated")


# Errors


@pytest.mark.parametrize(
    ("choose", "flags", "sentence"),
    [
        (flow, {"flow": "raft"}, "expected --flow classical, droid or python:M"),
        (features, {"features": "x"}, "classical, files:FOLDER, dinov2, fit3d or python:"),
        (depth, {"depth": "x"}, "none, simulated, sensor, files:FOLDER, metric3d, depth-a"),
        (flow, {"flow": "droid"}, "expected --flow-weights FILE with --flow droid, found none"),
        (depth, {"depth_weights": "a.pth"}, "expected --depth metric3d or depth-anything with"),
        (features, {"features": "fit3d", "features_weights": "none.pth"}, "found nothing at none"),
        (depth, {"depth": "simulated"}, "true depth in desk for --depth simulated, found none; u"),
        (flow, {"device": "tpu"}, "expected --device cpu or cuda, found 'tpu'"),
        (flow, {"precision": "fp16"}, "--precision fp32 or bf16 with --device cpu, found 'fp16'"),
        (flow, {"precision": "half"}, "--precision fp32 or bf16 with --device cpu, found 'half'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(choose, flags: dict[str, str], sentence: str):
    with pytest.raises(InputError, match=sentence):
        choose(**flags)


def test_a_gpu_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="expected a GPU that this torch can use"):
        flow(flow="droid", flow_weights="droid.pth", device="cuda")


def test_a_sensor_that_measured_nothing_is_no_prior(monkeypatch):
    for measured in (lambda self, index: None, lambda self, index: np.zeros((3, 4))):
        monkeypatch.setattr(Recorded, "sensor_depth", measured)
        with pytest.raises(InputError, match=r"a sensor's depth in desk, found none"):
            depth(depth="sensor")


def test_files_that_know_nothing_of_any_frame_are_no_prior(tmp_path: Path):
    images, folder = tum_folder(tmp_path / "desk", 3, (80, 64)), tmp_path / "made"
    folder.mkdir()
    sequence = open_sequence(str(images))

    def choose() -> DepthPrior:
        choice = PriorChoice(depth=f"files:{folder}")
        return choose_depth(choice, sequence, 0, NETWORKS)

    np.save(folder / "0.npy", np.full((64, 80), np.nan))
    np.save(folder / "1.npy", np.zeros((64, 80)))
    np.save(folder / "7.npy", np.ones((64, 80)))  # of no frame
    with pytest.raises(InputError, match=r"depth of any frame in .*made, found none; name the fil"):
        choose()
    np.save(folder / "2.npy", np.ones((64, 80)))
    assert choose()(sequence.frame(2), sequence.camera).unique().tolist() == [1.0]
