"""A finished run with nothing to warn of, made of what warnings and facts read."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from minislam.config import SlamConfig
from minislam.geometry import Camera
from minislam.records import TrackingStatus, Trajectory
from tests.helpers import random_transforms

CAMERA = Camera(272.0, 272.0, 160.0, 120.0, 320, 240)


def finished(**parts: object) -> SimpleNamespace:
    """Return a finished run of 20 frames without anything to warn of, but for these parts."""
    failed = parts.pop("failed", 0)
    graph = SimpleNamespace(
        adjustments=2 + failed,
        failed_adjustments=failed,
        least_parallax=1.0,
        seeks_focal=parts.pop("seeks_focal", False),
        focal_is_free=parts.pop("focal_is_free", False),
        grid=SimpleNamespace(camera=replace(CAMERA, fx=parts.pop("fx", 250.0))),
        shutter=SimpleNamespace(readout=(0.0, 0.0)),
    )
    lost, mapped = parts.pop("lost", range(0)), parts.pop("mapped", range(20))
    status = parts.pop("status", TrackingStatus.LOST)
    frames = [
        SimpleNamespace(
            frame_index=k, timestamp=k / 30, status=status if k in lost else TrackingStatus.OK
        )
        for k in range(20)
    ]
    tracker = SimpleNamespace(
        initialised=True,
        tracked=frames,
        graph=graph,
        knows_depth=parts.pop("knows_depth", True),
        watch=SimpleNamespace(
            diagnostics=[SimpleNamespace(parallax=p) for p in parts.pop("parallax", [5.0])],
            beyond_turns=0.41,
            depth_difference=0.26,
            has_two_depths=parts.pop("has_two_depths", False),
            hardly_walked=parts.pop("hardly_walked", False),
            breaks=parts.pop("breaks", []),
            segments=parts.pop("segments", [(0, 5), (7, 7)]),
            longest_piece=lambda poses: mapped,
        ),
        keyframes=SimpleNamespace(
            has_prior=parts.pop("has_prior", True), overlay=parts.pop("overlay", None)
        ),
    )
    truth = parts.pop("truth", None)  # s, of the true poses
    if truth is not None:
        poses = random_transforms(len(truth), "normal", 0).numpy()
        poses = np.tile(poses[:1], (len(truth), 1, 1)) if parts.pop("stands", False) else poses
        truth = SimpleNamespace(trajectory=Trajectory(np.array(truth), poses))
    shown = parts.pop("shown", [1.0])
    depth = (torch.arange(10) >= 10 * parts.pop("unknown", 0.0)).float()
    keyframes = [
        SimpleNamespace(frame_index=8 * k, depth=depth * (k == 0), inserts=k == 0, filled=None)
        for k in range(len(shown))
    ]
    hidden = torch.arange(10) >= 10 * parts.pop("left_out", 0.0)
    mapper = SimpleNamespace(shown=shown, images=keyframes, camera=CAMERA)
    mapper.beta_of, mapper.static_weight = lambda keyframe: hidden, lambda beta, camera: beta
    return SimpleNamespace(
        mapper=mapper,
        poses=dict.fromkeys(range(20)),
        first_frame=SimpleNamespace(best=0, worth=parts.pop("worth", (False, 0))),
        config=SlamConfig(),
        sequence=SimpleNamespace(
            warnings=[],
            camera=CAMERA,
            focal_origin=parts.pop("focal_origin", ""),
            ground_truth=truth,
            source_index=lambda k: 10 + 3 * k,
            preparation={"raw_camera": {"fx": 544.0}},
        ),
        lost_frames=lambda: [None] * len(lost),
        trajectory=lambda: Trajectory(np.arange(4) / 30, random_transforms(4, "normal", 1).numpy()),
        tracker=tracker,
        focal_length=parts.pop("focal_length", None),
        lens=parts.pop("lens", None),
        undone_lens=parts.pop("undone_lens", None),
    )
