"""Which Gaussians are projected, and in which order."""

import pytest
import torch

from minislam.geometry import Camera
from minislam.splatting.visible import project_gaussians
from tests.helpers import generator


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nearest_come_first_and_equal_depths_stay_in_map_order(dtype: torch.dtype):
    count = 500
    depths = torch.tensor([0.5, 1.0, 1.0 + 2**-20, 3.0, 1e6], dtype=dtype)
    means = torch.zeros(count, 3, dtype=dtype)
    means[:, 2] = depths[torch.randint(len(depths), (count,), generator=generator(0))]
    quats = torch.eye(4, dtype=dtype)[:1].expand(count, 4)
    projected = project_gaussians(
        means, quats, 0.01 * torch.ones(count, 3, dtype=dtype), means.new_full((count,), 0.5),
        None, torch.eye(4, dtype=dtype), Camera(50.0, 50.0, 20.0, 15.0, 40, 30),
    )  # fmt: skip
    expected = sorted(range(count), key=lambda row: float(means[row, 2]))  # stable
    assert projected.rows.tolist() == expected


def test_what_reaches_into_the_image_is_projected_and_what_ends_beside_it_is_not():
    camera = Camera(50.0, 50.0, 20.0, 15.0, 40, 30)
    beside = [(-8.0, 15.0), (47.0, 15.0), (20.0, -8.0), (20.0, 37.0)]  # px
    far = [(-60.0, 15.0), (99.0, 15.0), (20.0, -60.0), (20.0, 99.0)]
    positions = torch.tensor([*beside, *far, (20.0, 29.0), (39.0, 15.0)])
    means = camera.backproject(positions, torch.full((len(positions),), 2.0))
    projected = project_gaussians(
        means, torch.eye(4)[:1].expand(len(means), 4), torch.full((len(means), 3), 0.15),
        torch.full((len(means),), 0.5), None, torch.eye(4), camera,
    )  # fmt: skip
    assert projected.rows.tolist() == [0, 1, 2, 3, 8, 9]
