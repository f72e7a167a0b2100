"""The similarity that best maps one set of points to another (Umeyama, PAMI 1991)."""

from dataclasses import dataclass

import numpy as np

from minislam.errors import InputError, require

# Singular values of the covariance below this fraction of the largest are round-off.
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Similarity:
    """The map p -> scale * rotation @ p + translation: Sim(3), or SE(3) where scale is 1."""

    scale: float
    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) units of the target

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 3)."""
        return self.scale * points @ self.rotation.T + self.translation

    def transform_poses(self, T_world_camera: np.ndarray) -> np.ndarray:
        """Map camera poses (..., 4, 4): centres as points, axes by the rotation alone."""
        moved = np.array(T_world_camera, dtype=np.float64)
        moved[..., :3, :3] = self.rotation @ moved[..., :3, :3]
        moved[..., :3, 3] = self.transform_points(moved[..., :3, 3])
        return moved


def umeyama(
    source: np.ndarray,  # (N, 3) points to be mapped
    target: np.ndarray,  # (N, 3) where they should be mapped to
    with_scale: bool = True,  # False keeps the scale at 1
) -> Similarity:
    """Return the similarity with the least mean squared distance |target - S(source)|^2.

    With Sigma = mean of (target - mean)(source - mean)^T = U D V^T, equations (38) to (43) are

        R = U S V^T,   c = trace(D S) / var(source),   t = mean(target) - c R mean(source),

    where S is the identity, or diag(1, 1, -1) where U V^T would be a reflection. The rotation is
    unique only if D has rank 2 at least, because points on one line do not fix a rotation about it.
    """
    assert source.shape == target.shape and source.shape[1:] == (3,), (source.shape, target.shape)
    finite = int(np.isfinite(np.hstack([source, target])).all(1).sum())
    advice = "check that the timestamps of both trajectories belong together"
    found = f"{len(source)}, of which {finite} are finite; {advice}"
    require(finite == len(source) >= 3, "at least 3 pairs of finite points to align", found)
    source_mean, target_mean = source.mean(0), target.mean(0)  # (34), (35)
    source_centred, target_centred = source - source_mean, target - target_mean
    source_variance = (source_centred**2).sum(1).mean()  # (36)
    covariance = target_centred.T @ source_centred / len(source)  # (38)
    u, singular_values, v_transposed = np.linalg.svd(covariance)
    if singular_values[1] <= _RANK_TOLERANCE * singular_values[0]:
        found = "points that are (or a camera that does not move); no unique alignment exists"
        raise InputError(f"expected points that are not all on one line, found {found}")
    signs = np.ones(3)
    if np.linalg.det(u) * np.linalg.det(v_transposed) < 0:
        signs[2] = -1.0  # (39), (43)
    rotation = u @ np.diag(signs) @ v_transposed  # (40)
    scale = float(singular_values @ signs / source_variance) if with_scale else 1.0  # (42)
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)  # (41)
