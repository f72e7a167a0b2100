"""From the world to the image: where a Gaussian lands and which ellipse it covers (Sec. 3.1).

    x = W mu + t,   B = W L          mean and covariance factor in the camera frame
    mu' = (fx x/z + cx, fy y/z + cy)
    V = J B,   Sigma' = V V^T + 0.3 I,   Q = Sigma'^-1

W, t are the rotation and translation of T_camera_world and J = d mu' / d x. Each step has its
backward right below. Arrays are component-first, see splatting/__init__.py.
"""

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.splatting.constants import LOW_PASS_VARIANCE, tangent_limits


def to_camera(
    means: Tensor,  # (3, N) world units
    factors: Tensor,  # (3, 3, N) L in the world frame
    T_camera_world: Tensor,  # (4, 4)
) -> tuple[Tensor, Tensor]:  # (3, N), (3, 3, N)
    """Return x = W mu + t and B = W L in the camera frame. Slow twin: geometry.transform_points."""
    rotation, translation = T_camera_world[:3, :3], T_camera_world[:3, 3:]
    points_camera = torch.addmm(translation, rotation, means)
    return points_camera, (rotation @ factors.reshape(3, -1)).view_as(factors)


def to_camera_vjp(
    T_camera_world: Tensor,  # (4, 4)
    v_points_camera: Tensor,  # (3, N)
    v_camera_factors: Tensor,  # (3, 3, N)
) -> tuple[Tensor, Tensor]:  # (3, N), (3, 3, N)
    """Pull gradients in the camera frame back to the world: both turn with W^T."""
    rotation_t = T_camera_world[:3, :3].T
    v_factors = rotation_t @ v_camera_factors.reshape(3, -1)
    return rotation_t @ v_points_camera, v_factors.view_as(v_camera_factors)


def to_camera_twist_vjp(
    points_camera: Tensor,  # (3, N)
    camera_factors: Tensor,  # (3, 3, N)
    v_points_camera: Tensor,  # (3, N)
    v_camera_factors: Tensor,  # (3, 3, N)
) -> Tensor:  # (6,)  dL/d(rho, phi)
    """Pull gradients back to the pose, T_camera_world <- exp((rho, phi)) T_camera_world.

    To first order the camera sees dx = rho + phi x x and dB = phi x B (per column of B), so

        v_rho = sum v_x,        v_phi = sum x x v_x + sum over columns of B x v_B.

    The N cross products sum up to the antisymmetric part of one matrix product, M = X v_X^T.
    """
    outer = points_camera @ v_points_camera.T
    outer = outer + camera_factors.reshape(3, -1) @ v_camera_factors.reshape(3, -1).T
    v_phi = [outer[1, 2] - outer[2, 1], outer[2, 0] - outer[0, 2], outer[0, 1] - outer[1, 0]]
    return torch.cat([v_points_camera.sum(1), torch.stack(v_phi)])


def project_means(points_camera: Tensor, camera: Camera) -> Tensor:
    """Return the projected means mu' (2, N) in px of points (3, N). Slow twin: Camera.project."""
    x, y, z = points_camera
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def project_means_vjp(
    points_camera: Tensor,  # (3, N)
    camera: Camera,
    v_means2d: Tensor,  # (2, N)
) -> Tensor:  # (3, N)
    """Pull a pixel gradient back to the points, v_x = J^T v_mu'; to form J would take longer."""
    x, y, z = points_camera
    v_x = camera.fx * v_means2d[0] / z
    v_y = camera.fy * v_means2d[1] / z
    return torch.stack([v_x, v_y, -(x * v_x + y * v_y) / z])


def project_factors(
    points_camera: Tensor,  # (3, N)
    camera_factors: Tensor,  # (3, 3, N) B
    camera: Camera,
) -> Tensor:  # (2, 3, N) px
    """Return V = J B, the factors of the covariances in the image.

    With the tangents h = (x/z, y/z), limited to the surroundings of the view, the rows are

        V_u = fx/z (B_x - h_x B_z),   V_v = fy/z (B_y - h_y B_z).

    Slow twin: reference.project_covariances, which returns V V^T + 0.3 I.
    """
    (tangent_x, tangent_y), _ = _limited_tangents(points_camera, camera)
    along_x, along_y, along_z = camera_factors
    inverse_z = 1 / points_camera[2]
    factors_u = (along_x - tangent_x * along_z) * (camera.fx * inverse_z)
    factors_v = (along_y - tangent_y * along_z) * (camera.fy * inverse_z)
    return torch.stack([factors_u, factors_v])


def project_factors_vjp(
    points_camera: Tensor,  # (3, N)
    camera_factors: Tensor,  # (3, 3, N)
    factors2d: Tensor,  # (2, 3, N) the output V
    camera: Camera,
    v_factors2d: Tensor,  # (2, 3, N)
) -> tuple[Tensor, Tensor]:  # (3, N), (3, 3, N)
    """Return the gradients of points and factors from those of V; J depends on the points, too."""
    (tangent_x, tangent_y), inside = _limited_tangents(points_camera, camera)
    x, y, z = points_camera
    inverse_z = 1 / z
    v_along_x = v_factors2d[0] * (camera.fx * inverse_z)
    v_along_y = v_factors2d[1] * (camera.fy * inverse_z)
    v_along_z = -(tangent_x * v_along_x + tangent_y * v_along_y)

    v_tangent_x = -(v_along_x * camera_factors[2]).sum(0) * inside[0]
    v_tangent_y = -(v_along_y * camera_factors[2]).sum(0) * inside[1]
    scaling = (v_factors2d * factors2d).sum((0, 1))  # dV/dz at fixed tangents is -V/z
    v_z = -(v_tangent_x * x + v_tangent_y * y) * inverse_z - scaling
    v_points = torch.stack([v_tangent_x, v_tangent_y, v_z]) * inverse_z
    return v_points, torch.stack([v_along_x, v_along_y, v_along_z])


def conics_from_factors2d(
    factors2d: Tensor,  # (2, 3, N) px
) -> tuple[Tensor, Tensor]:  # (3, N) px^-2, (3, N) px^2
    """Return Q = Sigma'^-1 as (a, b, c) of [[a, b], [b, c]], and Sigma' = V V^T + 0.3 I."""
    (u0, u1, u2), (v0, v1, v2) = factors2d
    norm_u = u0 * u0 + u1 * u1 + u2 * u2
    norm_v = v0 * v0 + v1 * v1 + v2 * v2
    xx = norm_u + LOW_PASS_VARIANCE
    xy = u0 * v0 + u1 * v1 + u2 * v2
    yy = norm_v + LOW_PASS_VARIANCE
    # The determinant is |V_u x V_v|^2 + 0.3 (|V_u|^2 + |V_v|^2) + 0.3^2, a sum of positive terms:
    # xx yy - xy^2 loses all digits for long thin ellipses in float32.
    cross = (u1 * v2 - u2 * v1) ** 2 + (u2 * v0 - u0 * v2) ** 2 + (u0 * v1 - u1 * v0) ** 2
    determinant = cross + LOW_PASS_VARIANCE * (norm_u + yy)
    return torch.stack([yy, -xy, xx]) / determinant, torch.stack([xx, xy, yy])


def conics_from_factors2d_vjp(
    factors2d: Tensor,  # (2, 3, N)
    conics: Tensor,  # (3, N) the output Q
    v_conics: Tensor,  # (3, N)  dL/d(a, b, c), b counted once
) -> Tensor:  # (2, 3, N)
    """Pull a gradient of the conics Q back to the factors V.

    For symmetric G = [[v_a, v_b/2], [v_b/2, v_c]]: dL/dSigma' = S = -Q G Q, and Sigma' = V V^T
    gives v_V = 2 S V. The entry b appears twice in Q and its gradient is split in two halves.
    """
    a, b, c = conics
    v_a, half_v_b, v_c = v_conics[0], v_conics[1] / 2, v_conics[2]
    left_aa, left_ab = a * v_a + b * half_v_b, a * half_v_b + b * v_c  # rows of Q G
    left_ba, left_bb = b * v_a + c * half_v_b, b * half_v_b + c * v_c
    twice_xx = -2 * (left_aa * a + left_ab * b)
    twice_xy = -2 * (left_aa * b + left_ab * c)
    twice_yy = -2 * (left_ba * b + left_bb * c)
    along_u, along_v = factors2d
    v_u = twice_xx * along_u + twice_xy * along_v
    return torch.stack([v_u, twice_xy * along_u + twice_yy * along_v])


def _limited_tangents(points_camera: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return (x/z, y/z) (2, N), kept near the view, and where (2, N) they needed no limit."""
    tangents = points_camera[:2] / points_camera[2]
    lower, upper = (tangents.new_tensor(limit)[:, None] for limit in tangent_limits(camera))
    return torch.clamp(tangents, lower, upper), (tangents >= lower) & (tangents <= upper)
