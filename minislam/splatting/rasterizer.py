"""The renderer."""

from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting.gaussians import GaussianMap
from minislam.splatting.reference import render_reference
from minislam.splatting.rendering import Rendering


def render(
    gaussians: GaussianMap,
    camera: Camera,
    T_camera_world: Tensor,  # (4, 4)
    background: Tensor | None = None,  # (3,) RGB; None is black
    twist: Tensor | None = None,  # (6,) left perturbation of the pose: T <- exp(twist) T
    screen_offsets: Tensor | None = None,  # (N, 2) px, added to the projected means
) -> Rendering:
    """Render colour, depth and opacity of a map from a camera pose. Eq. (2)."""
    return render_reference(gaussians, camera, T_camera_world, background, twist, screen_offsets)
