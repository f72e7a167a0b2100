"""Rigid motions: SO(3) and SE(3), with exponential, logarithm and the left Jacobian.

The formulas divide by the rotation angle, so near zero each coefficient is replaced by the first
terms of its Taylor series. All functions take leading batch dimensions and keep dtype and device.
"""

import torch
from torch import Tensor

# Below this angle the Taylor series is exact to float64 round-off and the closed form is not.
_SMALL_ANGLE = 0.02  # radian
# Newton's method for the nearest rotation squares the error: three steps remove one of 1 %.
_ORTHONORMALISING_STEPS = 3


def hat(vectors: Tensor) -> Tensor:
    """Return the skew matrices of vectors (..., 3), so that hat(a) @ b = a x b."""
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    rows = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    return rows.reshape(*vectors.shape[:-1], 3, 3)


def so3_exp(phi: Tensor) -> Tensor:
    """Return the rotations (..., 3, 3) of rotation vectors phi (..., 3) [rad] (Rodrigues)."""
    return _rotation_and_left_jacobian(phi)[0]


def so3_log(rotations: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) [rad] of rotations (..., 3, 3), angle in [0, pi]."""
    # Not by phi = t / (2 sin t) * vee(R - R^T), which loses all digits near t = pi, but by the
    # quaternion, whose largest component never vanishes.
    q = quaternion_from_rotation(rotations)
    q = torch.where(q[..., :1] < 0, -q, q)
    sin_half = _safe_norm(q[..., 1:])
    angle = 2 * torch.atan2(sin_half, q[..., 0])
    # sin(t/2) ~ t/2 near the identity: the ratio tends to 2 and must not become 0/0.
    small = sin_half < 1e-9
    ratio = torch.where(small, torch.full_like(angle, 2.0), angle / sin_half.clamp_min(1e-30))
    return ratio[..., None] * q[..., 1:]


def quaternion_from_rotation(rotations: Tensor) -> Tensor:
    """Return unit quaternions wxyz (..., 4) of rotations (..., 3, 3) (Shepperd's method)."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotations.flatten(-2).unbind(-1)
    trace = m00 + m11 + m22
    wx, wy, wz = m21 - m12, m02 - m20, m10 - m01
    xy, xz, yz = m10 + m01, m20 + m02, m21 + m12
    # Row k is 4 q_k q, for k = w, x, y, z. That of the largest q_k loses no digits.
    rows = [
        1 + trace, wx, wy, wz,
        wx, 1 + 2 * m00 - trace, xy, xz,
        wy, xy, 1 + 2 * m11 - trace, yz,
        wz, xz, yz, 1 + 2 * m22 - trace,
    ]  # fmt: skip
    products = torch.stack(rows, -1).unflatten(-1, (4, 4))
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    chosen = products.gather(-2, index).squeeze(-2)
    return chosen / chosen.norm(dim=-1, keepdim=True)


def rotation_from_quaternion(quats_wxyz: Tensor) -> Tensor:
    """Return rotations (..., 3, 3) of quaternions wxyz (..., 4), which need not be unit."""
    w, x, y, z = (quats_wxyz / quats_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats_wxyz.shape[:-1], 3, 3)


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Return the quaternion (..., 4) wxyz of rotation a after rotation b."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    rows = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(rows, -1)


def se3_exp(xi: Tensor) -> Tensor:
    """Return the transforms (..., 4, 4) of tangent vectors xi = (rho, phi) (..., 6)."""
    rotation, V = _rotation_and_left_jacobian(xi[..., 3:])
    return make_transform(rotation, (V @ xi[..., :3, None]).squeeze(-1))


def se3_log(transforms: Tensor) -> Tensor:
    """Return the tangent vectors (rho, phi) (..., 6) of transforms (..., 4, 4)."""
    phi = so3_log(transforms[..., :3, :3])
    rho = torch.linalg.solve(so3_left_jacobian(phi), transforms[..., :3, 3])
    return torch.cat([rho, phi], -1)


def se3_inverse(transforms: Tensor) -> Tensor:
    """Return the inverse transforms (..., 4, 4): the transposed rotation, no general solve."""
    rotation_t = transforms[..., :3, :3].transpose(-1, -2)
    return make_transform(rotation_t, -(rotation_t @ transforms[..., :3, 3:]).squeeze(-1))


def se3_normalised(transforms: Tensor) -> Tensor:
    """Return transforms (..., 4, 4) with their rotations made orthonormal again."""
    # Every product adds a rounding error, which grows where the transpose serves as the inverse.
    rotation = transforms[..., :3, :3]
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    for _ in range(_ORTHONORMALISING_STEPS):
        rotation = rotation @ (1.5 * eye - 0.5 * rotation.transpose(-1, -2) @ rotation)
    return make_transform(rotation, transforms[..., :3, 3])


def se3_interpolate(first: Tensor, second: Tensor, fraction: float) -> Tensor:
    """Return the pose (..., 4, 4) at a fraction of the way at constant twist; 2 extrapolates."""
    motion = se3_log(second @ se3_inverse(first))
    return se3_normalised(se3_exp(fraction * motion) @ first)


def se3_adjoint(transforms: Tensor) -> Tensor:
    """Return Ad(T) = [[R, hat(t) R], [0, R]] (..., 6, 6), with T exp(xi) T^-1 = exp(Ad(T) xi)."""
    rotation = transforms[..., :3, :3]
    adjoint = transforms.new_zeros(*transforms.shape[:-2], 6, 6)
    adjoint[..., :3, :3] = adjoint[..., 3:, 3:] = rotation
    adjoint[..., :3, 3:] = hat(transforms[..., :3, 3]) @ rotation
    return adjoint


def so3_left_jacobian(phi: Tensor) -> Tensor:
    """Return V(phi) (..., 3, 3), with exp((rho, phi)) = (exp(phi), V(phi) rho)."""
    return _rotation_and_left_jacobian(phi)[1]


def _rotation_and_left_jacobian(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(phi) and V(phi), (..., 3, 3) each, because they share their coefficients."""
    # a = sin t / t, b = (1 - cos t) / t^2 and c = (t - sin t) / t^3 of the angle t = |phi|.
    angle = _safe_norm(phi)[..., None, None]
    small = angle < _SMALL_ANGLE
    t, t2 = torch.where(small, 1, angle), torch.where(small, angle, 0) ** 2
    a = torch.where(small, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), t.sin() / t)
    b = torch.where(small, (1 - t2 / 12 * (1 - t2 / 30 * (1 - t2 / 56))) / 2, (1 - t.cos()) / t**2)
    c = torch.where(small, (1 - t2 / 20 * (1 - t2 / 42 * (1 - t2 / 72))) / 6, (t - t.sin()) / t**3)
    skew, eye = hat(phi), torch.eye(3, dtype=phi.dtype, device=phi.device)
    squared = skew @ skew
    return eye + a * skew + b * squared, eye + b * skew + c * squared


def se3_left_jacobian(xi: Tensor) -> Tensor:
    """Return J (..., 6, 6), with exp(xi + d) = exp(J d) exp(xi) to first order in d.

    For xi = (rho, phi), ad = [[hat(phi), hat(rho)], [0, hat(phi)]] and J = sum ad^n / (n+1)!, which
    is the upper right block of the matrix exponential of [[ad, I], [0, 0]].
    """
    rho, phi = hat(xi[..., :3]), hat(xi[..., 3:])
    generator = xi.new_zeros(*xi.shape[:-1], 12, 12)
    generator[..., :3, :3] = generator[..., 3:6, 3:6] = phi
    generator[..., :3, 3:6] = rho
    generator[..., :6, 6:] = torch.eye(6, dtype=xi.dtype, device=xi.device)
    return torch.linalg.matrix_exp(generator)[..., :6, 6:]


def make_transform(rotation: Tensor, translation: Tensor) -> Tensor:
    """Assemble transforms (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    transform = rotation.new_zeros(*rotation.shape[:-2], 4, 4)
    transform[..., :3, :3] = rotation
    transform[..., :3, 3] = translation
    transform[..., 3, 3] = 1
    return transform


def transform_points(transforms: Tensor, points: Tensor) -> Tensor:
    """Apply transforms (..., 4, 4) to points (..., N, 3)."""
    return points @ transforms[..., :3, :3].transpose(-1, -2) + transforms[..., None, :3, 3]


def _safe_norm(vectors: Tensor) -> Tensor:
    """Return the norms (...) of vectors (..., 3) with gradient zero, not NaN, at the origin."""
    squared = (vectors * vectors).sum(-1)
    positive = squared > 0
    return torch.where(positive, squared, torch.ones_like(squared)).sqrt() * positive
