"""The shape of a Gaussian: Sigma = R(q) diag(s)^2 R(q)^T (Sec. 3.1), written as Sigma = L L^T.

The factor L = R(q) diag(s) is all that the renderer needs: it turns with the camera, projects
linearly, and keeps Sigma positive semi-definite. Arrays are component-first, see __init__.py.
"""

import torch
from torch import Tensor


def rotations(quats: Tensor) -> Tensor:  # (4, N) w, x, y, z of any length -> (3, 3, N)
    """Return the rotations of q, I for 0. Slow twin: geometry.se3.rotation_from_quaternion."""
    w, x, y, z = quats * _inverse_norms(quats)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows).unflatten(0, (3, 3))


def rotations_vjp(quats: Tensor, v_rotations: Tensor) -> Tensor:  # (4, N), (3, 3, N) -> (4, N)
    """Pull a gradient back from rotation matrices to quaternions."""
    inverse_norms, d = _inverse_norms(quats), v_rotations
    w, x, y, z = unit = quats * inverse_norms
    # By w it collects antisymmetric differences of d, by x, y, z symmetric sums and the diagonal.
    anti_x, anti_y, anti_z = d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]
    sum_x, sum_y, sum_z = d[2, 1] + d[1, 2], d[0, 2] + d[2, 0], d[1, 0] + d[0, 1]
    v_unit = torch.stack([
        x * anti_x + y * anti_y + z * anti_z,
        w * anti_x + y * sum_z + z * sum_y - 2 * x * (d[1, 1] + d[2, 2]),
        w * anti_y + x * sum_z + z * sum_x - 2 * y * (d[0, 0] + d[2, 2]),
        w * anti_z + x * sum_y + y * sum_x - 2 * z * (d[0, 0] + d[1, 1]),
    ]).mul_(2)  # fmt: skip
    # Only the part across q can change q / |q|.
    return (v_unit - unit * (unit * v_unit).sum(0)) * inverse_norms


def covariance_factors(quats: Tensor, scales: Tensor) -> Tensor:  # (4, N), (3, N) -> (3, 3, N)
    """Return L = R(q) diag(s) [world units] of Sigma = L L^T. Slow twin: reference.covariances."""
    return rotations(quats) * scales


def covariance_factors_vjp(
    quats: Tensor,  # (4, N)
    scales: Tensor,  # (3, N)
    v_factors: Tensor,  # (3, 3, N)  dL/dL
) -> tuple[Tensor, Tensor]:  # (4, N), (3, N)
    """Pull a gradient back from the factors to quaternions and scales."""
    # Column j of L is s_j times column j of R, so v_s_j = v_L_j . R_j and v_R_j = s_j v_L_j.
    v_scales = (v_factors * rotations(quats)).sum(0)
    return rotations_vjp(quats, v_factors * scales), v_scales


def _inverse_norms(quats: Tensor) -> Tensor:
    # Not norm(dim=0), which is forty times slower. The floor turns 0 into the identity, not NaN.
    return (quats * quats).sum(0).clamp_min_(torch.finfo(quats.dtype).tiny).rsqrt_()
