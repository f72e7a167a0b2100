"""The ray-caster: nearest surface, texture, one lamp, and the shadows of what moves.

Colours are averages over SUPERSAMPLE^2 rays per pixel. Depth and masks are exact answers for the
one ray through the pixel centre, in float64. Directions have z = 1 in the camera frame, so the ray
parameter of a hit IS its z-depth.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from .poses import Array, Intrinsics
from .shapes import Part

SUPERSAMPLE = 2  # rays per pixel side
FOOTPRINT = 0.6  # px, texture filter width: the spacing of the rays plus a little
NEAR = 0.05  # m, parts that reach behind this plane are not culled by their outline
AMBIENT, DIRECT = 0.45, 0.57  # light from everywhere and light from the lamp
SHADOW_DEPTH = 0.8  # part of the lamp's light that a mover takes away
SHADOW_MARGIN = 1e-3  # part of the way to the lamp, against a surface shading itself
BLUR_SIGMA = 0.5  # px, the lens
NOTHING = -1  # the index of a ray that met no part


@dataclass(frozen=True)
class RayGrid:
    """The rays of an image: one origin, directions by component."""

    origin: Array  # (3,) world
    directions: Array  # (3, rows, columns) world, z = 1 in the camera
    T_camera_world: Array  # (4, 4)
    intrinsics: Intrinsics
    supersample: int

    def window(self, part: Part) -> tuple[slice, slice] | None:
        """Return the rows and columns that can see the part, None where no ray can."""
        half = part.shape.half_extents
        corners = np.array(list(product((-1, 1), repeat=3))) * half
        T_camera_part = self.T_camera_world @ part.T_world_part
        corners = corners @ T_camera_part[:3, :3].T + T_camera_part[:3, 3]
        rows, columns = self.directions.shape[1:]
        if (corners[:, 2] < NEAR).all():
            return None
        if (corners[:, 2] < NEAR).any():
            return slice(0, rows), slice(0, columns)
        camera, scale = self.intrinsics, self.supersample
        across = camera.fx * corners[:, 0] / corners[:, 2] + camera.cx
        down = camera.fy * corners[:, 1] / corners[:, 2] + camera.cy
        left, right = _covered(across, scale, columns)
        top, bottom = _covered(down, scale, rows)
        if left >= right or top >= bottom:
            return None
        return slice(top, bottom), slice(left, right)


def _covered(pixels: Array, scale: int, count: int) -> tuple[int, int]:
    """Return the half-open range of ray indices between the outermost pixel coordinates."""
    first = int(np.floor((pixels.min() + 0.5) * scale - 0.5))
    last = int(np.ceil((pixels.max() + 0.5) * scale - 0.5))
    return max(first, 0), min(last + 1, count)


def camera_rays(
    intrinsics: Intrinsics,
    T_world_camera: Array,  # (4, 4)
    supersample: int = 1,
    dtype: type[np.floating] = np.float64,
) -> RayGrid:
    """Return the rays through the pixel centres, or through a finer grid inside each pixel."""
    columns = (np.arange(intrinsics.width * supersample) + 0.5) / supersample - 0.5
    rows = (np.arange(intrinsics.height * supersample) + 0.5) / supersample - 0.5
    across = ((columns - intrinsics.cx) / intrinsics.fx)[None, :]
    down = ((rows - intrinsics.cy) / intrinsics.fy)[:, None]
    R = T_world_camera[:3, :3]
    directions: Array = np.empty((3, len(rows), len(columns)), dtype)
    for axis in range(3):
        directions[axis] = R[axis, 0] * across + R[axis, 1] * down + R[axis, 2]
    origin: Array = T_world_camera[:3, 3].astype(dtype)
    inverse = np.linalg.inv(T_world_camera)
    return RayGrid(origin, directions, inverse, intrinsics, supersample)


def trace(
    parts: Sequence[Part],
    rays: RayGrid,
    depth: Array | None = None,  # (rows, columns) what is already in front
) -> tuple[Array, Array]:  # depth (rows, columns), index of the part seen (rows, columns)
    """Return the nearest hit of every ray in front of an optional known depth."""
    shape, dtype = rays.directions.shape[1:], rays.directions.dtype
    depth = np.full(shape, np.inf, dtype) if depth is None else depth.copy()
    index = np.full(shape, NOTHING, np.int16)
    for number, part in enumerate(parts):
        window = rays.window(part)
        if window is None:
            continue
        directions = rays.directions[(slice(None), *window)]
        hit = intersect_part(part, rays.origin, directions.reshape(3, -1))
        hit = hit.reshape(directions.shape[1:])
        nearer = hit < depth[window]
        np.copyto(depth[window], hit, where=nearer)
        np.copyto(index[window], np.int16(number), where=nearer)
    return depth, index


def intersect_part(part: Part, origin: Array, directions: Array) -> Array:
    """Return the ray parameters (N,) at which world rays meet a part, infinity on a miss."""
    R = part.T_world_part[:3, :3].astype(directions.dtype)
    local_origin = (origin - part.T_world_part[:3, 3]) @ part.T_world_part[:3, :3]
    return part.shape.intersect(local_origin.astype(directions.dtype), R.T @ directions)


@dataclass(frozen=True)
class Surface:
    """What a set of rays sees, before the light is decided."""

    rays: Array  # (N,) flat indices into the grid
    points: Array  # (3, N) world [m]
    albedo: Array  # (N, 3)
    facing: Array  # (N,) cosine between normal and lamp, 0 where turned away

    def colours(self, lit: Array | float = 1.0) -> Array:  # (N, 3)
        """Return the colours where `lit` (0 to 1) of the lamp's light arrives."""
        return self.albedo * (AMBIENT + DIRECT * lit * self.facing)[:, None]


def look_up_surface(
    parts: Sequence[Part], rays: RayGrid, depth: Array, index: Array, lamp: Array
) -> Surface:
    """Return textures and orientation towards the lamp of everything that `trace` found."""
    seen = np.flatnonzero(index.reshape(-1) != NOTHING)
    # Grouping the rays by part lets each texture be looked up once; a stable sort is radix here.
    seen = seen[np.argsort(index.reshape(-1)[seen], kind="stable")]
    owner = index.reshape(-1)[seen]
    directions = rays.directions.reshape(3, -1)[:, seen]
    z = depth.reshape(-1)[seen]
    points = rays.origin[:, None] + z * directions
    albedo = np.empty((len(seen), 3), np.float32)
    facing = np.empty(len(seen), np.float32)
    starts = np.searchsorted(owner, np.arange(len(parts) + 1))
    for number, part in enumerate(parts):
        group = slice(starts[number], starts[number + 1])
        if starts[number] == starts[number + 1]:
            continue
        spacing = z[group] * (FOOTPRINT / rays.intrinsics.fx)
        albedo[group], facing[group] = _paint(
            part, points[:, group], directions[:, group], spacing, lamp
        )
    return Surface(seen, points, albedo, facing)


def _paint(
    part: Part, points: Array, directions: Array, spacing: Array, lamp: Array
) -> tuple[Array, Array]:
    """Return albedo (N, 3) and lamp cosine (N,) of points on one part."""
    R = part.T_world_part[:3, :3].astype(points.dtype)
    translation = part.T_world_part[:3, 3].astype(points.dtype)
    local = R.T @ (points - translation[:, None])
    local_normals = part.shape.normals(local)
    normals = R @ local_normals
    slant = np.einsum("kn,kn->n", normals, directions)
    length = np.linalg.norm(directions, axis=0)
    # The inside of a dome is seen from behind: its normal turns towards the viewer.
    normals = np.where(slant > 0, -normals, normals)
    footprint = spacing / np.sqrt(np.clip(np.abs(slant) / length, 0.05, 1.0))

    to_lamp = lamp.astype(points.dtype)[:, None] - points
    facing = np.einsum("kn,kn->n", normals, to_lamp) / np.linalg.norm(to_lamp, axis=0)

    return _albedo(part, local, local_normals, footprint), np.maximum(facing, 0)


def _albedo(part: Part, local: Array, local_normals: Array, footprint: Array) -> Array:
    """Return the paint (N, 3): each point looks at the face that its normal points to most."""
    albedo = np.empty((local.shape[1], 3), np.float32)
    axis = np.abs(local_normals).argmax(axis=0)
    outward = local_normals[axis, np.arange(len(axis))] > 0
    per_face = len(part.textures) == 6
    face = 2 * axis + outward if per_face else axis
    for number in np.unique(face):
        here = face == number
        plane = number // 2 if per_face else number
        across, up = [k for k in range(3) if k != plane]
        texture = part.textures[number if per_face else 0]
        albedo[here] = texture.sample(local[across, here], local[up, here], footprint[here])
    return albedo


def lamp_visibility(points: Array, lamp: Array, movers: Sequence[Sequence[Part]]) -> Array:
    """Return how much of the lamp's light (N,) the movers let through to points (3, N)."""
    lit = np.ones(points.shape[1], np.float32)
    lamp = lamp.astype(points.dtype)
    from_lamp = points - lamp[:, None]
    distance = np.sqrt(np.einsum("kn,kn->n", from_lamp, from_lamp))
    from_lamp /= distance
    for parts in movers:
        centre, radius = enclosing_sphere(parts)
        near = np.flatnonzero(_meets_sphere(from_lamp, distance, centre - lamp, radius))
        rays, reach = from_lamp[:, near], distance[near] * (1 - SHADOW_MARGIN)
        for part in parts:
            centre, radius = part.bounding_sphere()
            chosen = np.flatnonzero(_meets_sphere(rays, reach, centre - lamp, radius))
            if len(chosen):
                hit = intersect_part(part, lamp, rays[:, chosen])
                lit[near[chosen[hit < reach[chosen]]]] = 1 - SHADOW_DEPTH
    return lit


def _meets_sphere(directions: Array, reach: Array, centre: Array, radius: float) -> Array:
    """Return which rays from the origin, unit and of length `reach`, come near a sphere."""
    along = centre.astype(directions.dtype) @ directions
    # A ray meets the sphere if it stays inside the cone that touches it.
    touching = np.sqrt(max(float(centre @ centre) - radius * radius, 0.0))
    return (along >= touching) & (along - radius < reach)


def enclosing_sphere(parts: Sequence[Part]) -> tuple[Array, float]:
    """Return centre (3,) and radius of a sphere around all parts of a mover [m]."""
    spheres = [part.bounding_sphere() for part in parts]
    centre = np.mean([c for c, _ in spheres], axis=0)
    return centre, max(float(np.linalg.norm(c - centre)) + r for c, r in spheres)


def ray_colours(
    statics: Sequence[Part],
    movers: Sequence[Sequence[Part]],
    lamp: Array,  # (3,)
    rays: RayGrid,
) -> tuple[Array, Array]:  # each (rows, columns, 3) float32
    """Return what the rays see with and without movers, sharing everything that does not move."""
    depth, index = trace(statics, rays)
    background = look_up_surface(statics, rays, depth, index, lamp)
    without = np.zeros((*depth.shape, 3), np.float32)
    without.reshape(-1, 3)[background.rays] = background.colours()
    if not movers:
        return without, without
    moving = [part for parts in movers for part in parts]
    depth, index = trace(moving, rays, depth)
    foreground = look_up_surface(moving, rays, depth, index, lamp)
    lit = lamp_visibility(background.points, lamp, movers)
    image = np.zeros_like(without)
    image.reshape(-1, 3)[background.rays] = background.colours(lit)
    image.reshape(-1, 3)[foreground.rays] = foreground.colours()
    return image, without


def develop(colours: Array, intrinsics: Intrinsics) -> Array:
    """Average the rays of each pixel and blur like a lens: (h, w, 3) float32 in [0, 1]."""
    return through_lens(average(colours, intrinsics))


def average(colours: Array, intrinsics: Intrinsics) -> Array:
    """Return the mean of the rays of each pixel: (h, w, 3) float32."""
    size = (intrinsics.width, intrinsics.height)
    return cv2.resize(colours, size, interpolation=cv2.INTER_AREA)


def through_lens(image: Array) -> Array:
    """Blur an image as a lens does: (h, w, 3) float32 in [0, 1]."""
    return np.clip(cv2.GaussianBlur(image, (5, 5), BLUR_SIGMA), 0, 1)


@dataclass(frozen=True)
class Exposure:
    """One pose rendered with movers and without."""

    rgb: Array  # (height, width, 3) float32 in [0, 1], no noise
    depth: Array  # (height, width) float32, z-depth of what is seen [m]
    mover_mask: Array  # (height, width) bool
    static_rgb: Array  # (height, width, 3) float32 in [0, 1]


def expose(
    statics: Sequence[Part],
    movers: Sequence[Sequence[Part]],
    counted: Sequence[bool],  # for each mover, whether it belongs in the mask
    lamp: Array,  # (3,)
    T_world_camera: Array,  # (4, 4)
    intrinsics: Intrinsics,
) -> Exposure:
    """Render one pose with and without movers."""
    rays = camera_rays(intrinsics, T_world_camera, SUPERSAMPLE, np.float32)
    both = ray_colours(statics, movers, lamp, rays)
    rgb, static_rgb = (develop(colours, intrinsics) for colours in both)
    centre_rays = camera_rays(intrinsics, T_world_camera)
    depth, _ = trace(statics, centre_rays)
    depth, index = trace([part for parts in movers for part in parts], centre_rays, depth)
    in_mask = [counts for parts, counts in zip(movers, counted, strict=True) for _ in parts]
    mask = np.array([*in_mask, False])[index]  # the last is that of NOTHING
    return Exposure(rgb, depth.astype(np.float32), mask, static_rgb)
