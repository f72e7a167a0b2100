"""The solids a scene is built of, each with its own exact ray intersection.

Every shape lives in its own frame, centred at the origin. Rays come as one origin and many
directions stored by component, (3, N), and `intersect` answers with the ray parameter of the first
surface in front of the origin, infinity where there is none. A ray that starts inside a solid
misses it: cameras do not enter furniture, and a lamp may sit inside its own shade.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .poses import Array
from .textures import Texture

TINY = 1e-12  # keeps 1/d finite for rays parallel to a face; far below any direction that matters


class Shape(Protocol):
    """What the ray-caster needs to know about a solid."""

    @property
    def half_extents(self) -> Array:
        """Half the sides of the bounding box (3,) [m]."""

    def intersect(self, origin: Array, directions: Array) -> Array:
        """Return the parameters (N,) at which rays (3,), (3, N) meet it, infinity on a miss."""

    def normals(self, points: Array) -> Array:
        """Return the unit normals (3, N), outwards, at points (3, N) on its surface."""


def _slab(origin: Array, directions: Array, half: Array) -> tuple[Array, Array]:
    """Return entry and exit parameters of the block |p_k| <= half_k, for the axes given."""
    safe = np.where(np.abs(directions) < TINY, TINY, directions)
    first = (-half - origin)[:, None] / safe
    second = (half - origin)[:, None] / safe
    return np.minimum(first, second).max(axis=0), np.maximum(first, second).min(axis=0)


def _disc(origin: Array, directions: Array, radius: float) -> tuple[Array, Array]:
    """Return entry and exit parameters of |p| = radius over the components given; nan on a miss."""
    squared = np.maximum(np.einsum("kn,kn->n", directions, directions), TINY)
    middle = -(origin @ directions) / squared
    # The distance of closest approach, rather than b^2 - ac, keeps float32 silhouettes smooth.
    closest = origin[:, None] + middle * directions
    room = radius * radius - np.einsum("kn,kn->n", closest, closest)
    with np.errstate(invalid="ignore"):
        half_chord = np.sqrt(room / squared)
    return middle - half_chord, middle + half_chord


def _dominant_axis_normals(points: Array, half: Array) -> Array:
    """Return the normal of the box face that each point lies on."""
    relative = points / half[:, None]
    axis = np.abs(relative).argmax(axis=0)
    columns = np.arange(points.shape[1])
    normals = np.zeros_like(points)
    normals[axis, columns] = np.sign(relative[axis, columns])
    return normals


@dataclass(frozen=True)
class Box:
    """A block with side lengths `size` [m]."""

    size: tuple[float, float, float]

    @property
    def half_extents(self) -> Array:
        return np.array(self.size) / 2

    def intersect(self, origin: Array, directions: Array) -> Array:
        half = self.half_extents.astype(directions.dtype)
        near, far = _slab(origin, directions, half)
        return np.where((near < far) & (near > 0), near, np.inf).astype(directions.dtype)

    def normals(self, points: Array) -> Array:
        return _dominant_axis_normals(points, self.half_extents.astype(points.dtype))


@dataclass(frozen=True)
class Interior:
    """A block seen from inside: the six planes of an empty room."""

    size: tuple[float, float, float]

    @property
    def half_extents(self) -> Array:
        return np.array(self.size) / 2

    def intersect(self, origin: Array, directions: Array) -> Array:
        return _slab(origin, directions, self.half_extents.astype(directions.dtype))[1]

    def normals(self, points: Array) -> Array:
        return -_dominant_axis_normals(points, self.half_extents.astype(points.dtype))


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with semi-axes `radii`, open below z = lowest * radii[2] (a dome if > -1)."""

    radii: tuple[float, float, float]
    lowest: float = -1.0

    @property
    def half_extents(self) -> Array:
        return np.array(self.radii)

    def intersect(self, origin: Array, directions: Array) -> Array:
        radii = self.half_extents.astype(directions.dtype)
        origin, directions = origin / radii, directions / radii[:, None]
        near, far = _disc(origin, directions, 1.0)
        if self.lowest <= -1.0:
            return np.where(near > 0, near, np.inf).astype(directions.dtype)
        # A dome is a shell: where the near side is cut away its inside can be seen.
        with np.errstate(invalid="ignore"):
            near_seen = (near > 0) & (origin[2] + near * directions[2] >= self.lowest)
            far_seen = (far > 0) & (origin[2] + far * directions[2] >= self.lowest)
        hit = np.where(near_seen, near, np.where(far_seen, far, np.inf))
        return hit.astype(directions.dtype)

    def normals(self, points: Array) -> Array:
        radii = self.half_extents.astype(points.dtype)
        gradient = points / (radii * radii)[:, None]
        return gradient / np.linalg.norm(gradient, axis=0)


@dataclass(frozen=True)
class Cylinder:
    """A closed upright cylinder [m]."""

    radius: float
    height: float

    @property
    def half_extents(self) -> Array:
        return np.array([self.radius, self.radius, self.height / 2])

    def intersect(self, origin: Array, directions: Array) -> Array:
        half = self.half_extents.astype(directions.dtype)
        side_near, side_far = _disc(origin[:2], directions[:2], half[0])
        cap_near, cap_far = _slab(origin[2:], directions[2:], half[2:])
        near, far = np.maximum(side_near, cap_near), np.minimum(side_far, cap_far)
        return np.where((near < far) & (near > 0), near, np.inf).astype(directions.dtype)

    def normals(self, points: Array) -> Array:
        radial = np.hypot(points[0], points[1])
        on_cap = np.abs(points[2]) / (self.height / 2) > radial / self.radius
        normals = points / np.maximum(radial, TINY)
        normals[2] = 0
        normals[:, on_cap] = 0
        normals[2, on_cap] = np.sign(points[2, on_cap])
        return normals


@dataclass(frozen=True)
class Capsule:
    """A cylinder of the given radius and length between the centres of two half spheres [m]."""

    radius: float
    length: float

    @property
    def half_extents(self) -> Array:
        return np.array([self.radius, self.radius, self.radius + self.length / 2])

    def intersect(self, origin: Array, directions: Array) -> Array:
        radius, half = directions.dtype.type(self.radius), directions.dtype.type(self.length / 2)
        side = _disc(origin[:2], directions[:2], radius)[0]
        height = origin[2] + side * directions[2]
        # The capsule lies inside its infinite cylinder, so the height at which a ray enters the
        # cylinder says which of body, upper and lower half sphere it can meet first.
        above = _disc(origin - np.array([0, 0, half], half.dtype), directions, radius)[0]
        below = _disc(origin + np.array([0, 0, half], half.dtype), directions, radius)[0]
        hit = np.where(np.abs(height) <= half, side, np.where(height > half, above, below))
        return np.where(hit > 0, hit, np.inf).astype(directions.dtype)

    def normals(self, points: Array) -> Array:
        outward = points.copy()
        outward[2] -= np.clip(points[2], -self.length / 2, self.length / 2)
        return outward / np.linalg.norm(outward, axis=0)


@dataclass(frozen=True)
class Part:
    """A shape placed in the world and wrapped in textures (one, or one per box face)."""

    shape: Shape
    T_world_part: Array  # (4, 4)
    textures: tuple[Texture, ...]  # 1, or 6 by normal: -x +x -y +y -z +z

    def bounding_sphere(self) -> tuple[Array, float]:
        """Return centre (3,) and radius of a sphere around the part [m]."""
        return self.T_world_part[:3, 3], float(np.linalg.norm(self.shape.half_extents))
