"""Lens distortion (Brown's model), removed once when an image is read."""

from dataclasses import dataclass

import cv2
import numpy as np

from minislam.geometry.camera import Camera


@dataclass(frozen=True)
class BrownDistortion:
    """Radial (k1, k2, k3) and tangential (p1, p2) coefficients, in OpenCV's convention."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0

    @property
    def coefficients(self) -> np.ndarray:
        """Return the coefficients (5,) in OpenCV's order k1, k2, p1, p2, k3."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    def undistortion_maps(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the two maps (H, W) [px] of cv2.remap from a raw image to that of `camera`.

        The seen radius r (1 + k1 r^2 + k2 r^4 + k3 r^6) may shrink again from some true radius r
        on, where the model mirrors the image: there the first map is -1, outside the raw image.
        """
        # OpenCV, like this package, puts the centre of the first pixel at (0, 0).
        K, size = camera_matrix(camera), (camera.width, camera.height)
        maps = cv2.initUndistortRectifyMap(K, self.coefficients, None, K, size, cv2.CV_32FC1)
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy) / camera.fy
        squared = x**2 + y[:, None] ** 2
        with np.errstate(over="ignore", invalid="ignore"):  # of absurd coefficients
            slope = np.polyval([7 * self.k3, 5 * self.k2, 3 * self.k1, 1], squared)
        maps[0][squared >= squared[slope <= 0].min(initial=np.inf)] = -1
        return maps


def camera_matrix(camera: Camera) -> np.ndarray:
    """Return the calibration matrix K (3, 3)."""
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
