"""Gaussian maps as PLY files in the layout that 3D Gaussian viewers agree on.

The values are raw, and colours are the zeroth coefficient of spherical harmonics. Activated values
would make viewers show fog, or nothing.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from minislam.data.files import read_bytes
from minislam.errors import require

_SH_C0 = 0.28209479177387814  # Y_00 = 1 / (2 sqrt(pi)): colour = 0.5 + Y_00 * f_dc

# exp(20) world units is larger than any scene, exp(-20) smaller than any surface; values beyond
# are mistakes (scales that were not logarithms), and some viewers hang on them.
_MAX_LOG_SCALE = 20.0
# In the order of the original implementation; other files may hold f_rest_0, ... as well.
PROPERTIES = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
    "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_FORMAT = ["ply", "format binary_little_endian 1.0"]  # the first two lines


@dataclass(frozen=True)
class GaussianArrays:
    """The raw values of N Gaussians, as plain arrays."""

    means: np.ndarray  # (N, 3) world units
    log_scales: np.ndarray  # (N, 3) natural logarithm of standard deviations in world units
    quats_wxyz: np.ndarray  # (N, 4) need not be normalised
    opacity_logits: np.ndarray  # (N,)
    colors: np.ndarray  # (N, 3) RGB in [0, 1]

    def __len__(self) -> int:
        return len(self.means)


def encode_ply(gaussians: GaussianArrays, sh_degree: int = 0) -> bytes:
    """Return the bytes of a PLY file; above degree 0, which some viewers insist on, all is 0."""
    _validate(gaussians, "the map")
    quats = gaussians.quats_wxyz.astype(np.float64)
    zeros = np.zeros((len(gaussians), 3 * ((sh_degree + 1) ** 2 - 1)))
    rest = [f"f_rest_{index}" for index in range(zeros.shape[1])]
    names = [*PROPERTIES[:9], *rest, *PROPERTIES[9:]]
    columns = [
        gaussians.means,
        np.zeros_like(gaussians.means),  # normals, which no viewer reads
        # Not clamped to [0, 1], because a map that is read back must render as it did.
        (gaussians.colors - 0.5) / _SH_C0,
        zeros,
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
    ]
    table = np.concatenate([column.astype("<f4") for column in columns], axis=1)
    return _encoded(table, [f"float {name}" for name in names])


def encode_points(points: np.ndarray, colors: np.ndarray) -> bytes:
    """Return the bytes of a PLY file of points (N, 3) in world units, coloured (N, 3) uint8 RGB."""
    table = np.empty(len(points), [("xyz", "<f4", 3), ("rgb", "u1", 3)])
    table["xyz"], table["rgb"] = points, colors
    names = ["float x", "float y", "float z", "uchar red", "uchar green", "uchar blue"]
    return _encoded(table, names)


def _encoded(table: np.ndarray, properties: list[str]) -> bytes:
    lines = [*_FORMAT, f"element vertex {len(table)}"]
    lines += [f"property {name}" for name in properties] + ["end_header\n"]
    return "\n".join(lines).encode("ascii") + table.tobytes()


def read_ply(path: Path | str) -> GaussianArrays:
    """Read a Gaussian map; of spherical harmonics only the mean colour is kept."""
    content, name = read_bytes(path), str(path)
    header, ended, body = content.partition(b"end_header\n")
    count, names = _parse_header(header if ended else b"", name)
    length = 4 * count * len(names)
    found = f"{len(body)} in {name}; the file is cut short or damaged"
    require(len(body) == length, f"{length} bytes for {count} Gaussians", found)
    table = np.frombuffer(body, dtype="<f4").reshape(count, len(names))

    def take(*wanted: str) -> np.ndarray:
        return table[:, [names.index(one) for one in wanted]].copy()

    with np.errstate(over="ignore", invalid="ignore"):  # damaged values are refused below
        gaussians = GaussianArrays(
            means=take("x", "y", "z"),
            log_scales=take("scale_0", "scale_1", "scale_2"),
            quats_wxyz=take("rot_0", "rot_1", "rot_2", "rot_3"),
            opacity_logits=take("opacity")[:, 0],
            colors=take("f_dc_0", "f_dc_1", "f_dc_2") * np.float32(_SH_C0) + np.float32(0.5),
        )
    _validate(gaussians, name)
    return gaussians


def _parse_header(header: bytes, name: str) -> tuple[int, list[str]]:
    """Return the number of Gaussians and the property names."""
    rows = header.decode("ascii", errors="replace").splitlines()
    lines = [row for row in rows if not row.startswith(("comment", "obj_info"))]
    is_ply, found = lines[:2] == _FORMAT and len(lines) > 2, f"another kind of file in {name}"
    require(is_ply, "a binary little-endian PLY file with Gaussians", f"{found}; give a map.ply")
    element, *fields = [line.split() for line in lines[2:]]
    plain = all(len(field) == 3 and field[:2] == ["property", "float"] for field in fields)
    names = [field[2] for field in fields] if plain else []
    missing = sorted(set(PROPERTIES) - {"nx", "ny", "nz"} - set(names))
    counted = re.fullmatch(r"element vertex \d{1,18}", " ".join(element)) is not None
    is_right = not missing and counted and len(set(names)) == len(names)
    wanted = "'element vertex N' and the float properties of 3D Gaussians"
    found = f"a header without {', '.join(missing[:3]) or 'them, or with doubles'} in {name}"
    require(is_right, wanted, f"{found}; give a map.ply")
    return int(element[2]), names


def _validate(gaussians: GaussianArrays, name: str) -> None:
    """Refuse values that would hang or blind a viewer."""
    for what, values in vars(gaussians).items():
        bad = int((~np.isfinite(values)).sum())
        found = f"{bad} values that are NaN or infinite; remove these Gaussians"
        require(bad == 0, f"finite {what} in {name}", found)
    worst = np.abs(gaussians.log_scales).max(initial=0)
    found = f"{worst:.3g}; store scales as natural logarithms"
    require(worst < _MAX_LOG_SCALE, f"|log scale| < {_MAX_LOG_SCALE:g} in {name}", found)
    turns = np.linalg.norm(gaussians.quats_wxyz.astype(float), axis=1).min(initial=1) >= 1e-12
    require(turns, f"quaternions other than zero in {name}", "a zero one; it is no rotation")
