"""The whole system on a real GPU, where there is one."""

from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from tests.test_slam_device import Run, new_slam, on_cpu, short_stages  # noqa: F401, a fixture

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU"),
]


@pytest.mark.parametrize("kind", ["depth", "no depth", "networks"])
def test_a_real_gpu_gives_nearly_what_the_cpu_gives(kind: str, root: Path):
    def save(force: bool) -> None:
        if slam.steps.done("tracking and mapping") == 3:
            write_checkpoint(root / kind, slam.saved_state())

    slam = new_slam(kind, "cuda", save)
    slam.run()
    resumed = new_slam(kind, "cuda")
    resumed.restore_state(read_checkpoint(root / kind, "cuda"), resumed.frame)
    resumed.run()
    for each in (slam, resumed):  # last digits differ, and with them what is pruned [world units]
        np.testing.assert_allclose(Run(each).results[0], on_cpu(kind).results[0], atol=5e-3)
        assert {t.device.type for t in each.mapper.gaussians.parameters.values()} == {"cuda"}
