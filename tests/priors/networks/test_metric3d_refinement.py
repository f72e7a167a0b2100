"""The refinement of Metric3D: upsampling on logits that make its answer known.

That its results are those of the official code is tested with the whole network.
"""

import torch
from torch.nn import functional

from minislam.priors.networks.metric3d import convex_upsample
from tests.helpers import generator


def test_upsampling_with_even_weights_averages_the_neighbourhood():
    coarse = torch.rand(1, 2, 4, 5, generator=generator(0))
    fine = convex_upsample(coarse, torch.zeros(1, 9 * 16, 4, 5), 4)
    mean = functional.avg_pool2d(coarse, 3, stride=1, padding=1)
    torch.testing.assert_close(fine, mean.repeat_interleave(4, 2).repeat_interleave(4, 3))


def test_upsampling_takes_the_neighbour_that_the_logits_name():
    coarse = torch.arange(20.0).view(1, 1, 4, 5)
    logits = torch.zeros(1, 9, 2, 2, 4, 5)
    logits[:, 5] = 50.0  # row-major in 3x3: the right neighbour
    fine = convex_upsample(coarse, logits.view(1, 36, 4, 5), 2)
    torch.testing.assert_close(fine[0, 0, 2, 2], coarse[0, 0, 1, 2])
    assert fine[0, 0, 0, 9] < 1e-9  # outside of the map is zero
