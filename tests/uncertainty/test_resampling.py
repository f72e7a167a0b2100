import torch

from minislam.uncertainty.resampling import resample


def test_resampling_keeps_a_constant_and_hits_cell_centres():
    ramp = torch.arange(24.0)[None].expand(20, 24)
    # 4 cells over 24 px: centres at (j + 0.5) * 6 - 0.5.
    torch.testing.assert_close(resample(ramp, 5, 4)[2], torch.tensor([2.5, 8.5, 14.5, 20.5]))


def test_upsampling_puts_cell_centres_where_the_convention_says():
    # 4 cells over 32 px: centres at (j + 0.5) * 8 - 0.5 = 3.5, 11.5, ...; a ramp stays a ramp.
    ramp = torch.arange(4.0)[None].expand(3, 4)
    image = resample(ramp, 24, 32)
    u = torch.arange(32.0)
    inside = (u >= 3.5) & (u <= 27.5)
    torch.testing.assert_close(image[10][inside], ((u - 3.5) / 8)[inside])
