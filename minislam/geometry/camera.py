"""The pinhole camera: projection, its Jacobians, back-projection, resizing."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from minislam.errors import require

LONGEST_FOCAL = 1e6  # px; beyond it the field of view is nothing, and squares overflow
REFERENCE_DIAGONAL = 400.0  # px, of the 320x240 image that thresholds in pixels belong to


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion. The centre of the first pixel is (0, 0).

    Focal lengths and principal point are in pixels of an image of `width` x `height`. It is the
    only camera model: images of other lenses are undistorted when they are read.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        is_positive = all(0 < focal <= LONGEST_FOCAL for focal in (self.fx, self.fy))
        found = f"fx={self.fx} fy={self.fy}; give them in pixels with --fx and --fy"
        require(is_positive, f"positive focal lengths up to {LONGEST_FOCAL:g}", found)
        size = f"{self.width}x{self.height}"
        require(min(self.width, self.height) >= 1, "an image of at least 1x1 pixels", size)
        is_inside = -0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5
        found = f"cx={self.cx} cy={self.cy}; check that calibration and images belong together"
        require(is_inside, f"a principal point inside the {size} image", found)

    def project(self, points_camera: Tensor) -> Tensor:
        """Return pixels (..., 2) of points (..., 3) in front of the camera.

        u = fx x / z + cx,  v = fy y / z + cy. The caller masks points with z <= 0.
        """
        x, y, z = points_camera.unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], -1)

    def project_jacobian(self, points_camera: Tensor) -> Tensor:
        """Return d(u, v)/d(x, y, z) (..., 2, 3) at points (..., 3)."""
        x, y, z = points_camera.unbind(-1)
        zero = torch.zeros_like(z)
        rows = [self.fx / z, zero, -self.fx * x / z**2, zero, self.fy / z, -self.fy * y / z**2]
        return torch.stack(rows, -1).reshape(*points_camera.shape[:-1], 2, 3)

    def twist_jacobian(
        self,
        ray_x: Tensor,  # (..., N) x / z of points in the camera frame
        ray_y: Tensor,  # (..., N) y / z
        inverse_depth: Tensor,  # (..., N) 1 / z
    ) -> Tensor:  # (..., 6, 2, N) px per unit of the twist
        """Return d(u, v)/d(rho, phi) of points when the pose moves by exp((rho, phi)) on the left.

        To first order a point p moves by rho + phi x p, so the Jacobian is that of the projection
        times [I | -hat(p)]. With p = (a, b, 1) / e, where e = 1/z, its rows are

            du:  fx (e, 0, -e a,   -a b,     1 + a^2, -b)
            dv:  fy (0, e, -e b,   -1 - b^2,  a b,     a).

        Points at infinity have e = 0, and only a rotation moves them.
        """
        a, b, e = ray_x, ray_y, inverse_depth
        fx, fy, zero = self.fx, self.fy, torch.zeros_like(ray_x)
        columns = [
            fx * e, zero,
            zero, fy * e,
            fx * (-e * a), fy * (-e * b),
            fx * (-a * b), fy * (-1 - b * b),
            fx * (1 + a * a), fy * (a * b),
            fx * -b, fy * a,
        ]  # fmt: skip
        return torch.stack(columns, -2).unflatten(-2, (6, 2))

    def rays(self, pixels: Tensor) -> Tensor:
        """Return the rays (..., 3) of pixels (..., 2), scaled to z = 1."""
        x = (pixels[..., 0] - self.cx) / self.fx
        y = (pixels[..., 1] - self.cy) / self.fy
        return torch.stack([x, y, torch.ones_like(x)], -1)

    def backproject(self, pixels: Tensor, depth: Tensor) -> Tensor:
        """Return the points (..., 3) in the camera frame of pixels (..., 2) at z-depths (...)."""
        return self.rays(pixels) * depth[..., None]

    def pixel_grid(
        self,
        stride: int = 1,  # px between neighbouring cells
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> Tensor:  # (ceil(H/stride), ceil(W/stride), 2)
        """Return the pixel of each cell: the first is (0, 0), the next (stride, 0), and so on."""
        u = torch.arange(0, self.width, stride, dtype=dtype, device=device)
        v = torch.arange(0, self.height, stride, dtype=dtype, device=device)
        return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same image resized: c -> (c + 0.5) s - 0.5 per axis."""
        sx, sy = width / self.width, height / self.height
        cx = min((self.cx + 0.5) * sx, width) - 0.5  # rounding must not put it outside
        cy = min((self.cy + 0.5) * sy, height) - 0.5
        return Camera(self.fx * sx, self.fy * sy, cx, cy, width, height)

    def cropped(self, left: int, top: int, width: int, height: int) -> "Camera":
        """Return the camera of the window of `width` x `height` that starts at (left, top)."""
        return Camera(self.fx, self.fy, self.cx - left, self.cy - top, width, height)

    def contains(self, pixels: Tensor) -> Tensor:
        """Tell which positions (..., 2) lie between the centres of the outermost pixels."""
        u, v = pixels.unbind(-1)
        return (u >= 0) & (u <= self.width - 1) & (v >= 0) & (v <= self.height - 1)


def pixel_scale(camera: Camera) -> float:
    """Return how many px equal one of a 320x240 image, for which thresholds in px are given."""
    return math.hypot(camera.width, camera.height) / REFERENCE_DIAGONAL
