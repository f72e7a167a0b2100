"""One look for all figures: sizes, colours, and bytes that do not change from run to run."""

import io
from collections.abc import Sequence as Series
from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps, rcParams
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

WIDE = 9.0, 3.0  # inch

# The truth is drawn on top of the estimate.
TRUTH_STYLE: dict[str, Any] = {"color": "black", "linestyle": "--", "linewidth": 1.2, "zorder": 3}
ESTIMATE_STYLE: dict[str, Any] = {"color": "tab:blue", "linestyle": "-", "linewidth": 1.4}

_BETA_TICKS = (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 1, 2, 3, 5, 10)
_COLORMAPS = {"depth": "viridis", "beta": "magma", "weight": "gray", "error": "RdBu_r"}
_DPI = 110  # dots per inch
_UNKNOWN_RGB = (0.25, 0.25, 0.25)  # where there is no depth
_QUANTILES = (0.02, 0.98)  # a few outliers must not take the whole colour range
_LEAST_BETA = 0.1  # a smaller one counts as this, `uncertainty.weights.clipped_beta`
# A range at least this wide keeps the noise of a static frame from filling all colours, and bright
# is only what the map leaves out, `uncertainty.weights.BETA_CUT`, or nearly.
_LEAST_BETA_RATIO, _BRIGHT_BETA = 4.0, 1.41
_LEAST_DEPTH_RATIO = 1.1  # of the farthest to the nearest: a backdrop is one colour

Limits = tuple[float, float]  # values of the first and the last colour; None: from all values


def set_notebook_style() -> None:
    """Let the figures of pyplot look like those of `new_figure`, sharp enough to be projected."""
    rcParams.update({"figure.dpi": _DPI, "figure.constrained_layout.use": True, "font.size": 9})


def new_figure(size: tuple[float, float] = WIDE) -> Figure:
    """Return an empty figure (inches) that belongs to no window and no global state."""
    return Figure(figsize=size, dpi=_DPI, layout="constrained")


def figure_png(figure: Figure, dpi: float = _DPI) -> bytes:
    """Return a figure as PNG: the same bytes for the same figure, without date or version."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def figure_picture(figure: Figure) -> np.ndarray:  # (H, W, 3) uint8
    """Turn a figure into a picture; one of `new_figure` is shown nowhere else."""
    png = np.frombuffer(figure_png(figure, figure.dpi), np.uint8)
    return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR_RGB))


def show_image(
    axes: Axes,
    image: np.ndarray,  # (h, w, 3) RGB in [0, 1]
    title: str,
    size: tuple[int, int] | None = None,  # (H, W) px to stretch a coarse grid to
) -> None:
    """Draw a picture without axes."""
    height, width = size or image.shape[:2]
    area = (-0.5, width - 0.5, height - 0.5, -0.5)  # the centre of the first pixel is (0, 0)
    axes.imshow(np.clip(image, 0, 1), interpolation="nearest", extent=area)
    axes.set_title(title, fontsize=9)
    axes.set_axis_off()


def show_map(
    axes: Axes,
    values: np.ndarray,  # (h, w)
    kind: str,  # as of `colour_bar`
    title: str,
    limits: Limits | None = None,  # None: from the values
    size: tuple[int, int] | None = None,  # (H, W) px to stretch a coarse grid to
    label: str | None = None,
) -> None:
    """Draw a map of numbers with the colours of its kind, and their colour bar beside it."""
    values = np.asarray(values, dtype=np.float64)
    if kind == "depth":
        limits = limits or depth_limits(values)
        picture = depth_to_rgb(values, limits)
    elif kind == "beta":
        limits = limits or beta_limits(values)
        picture = beta_to_rgb(values, limits)
    else:
        largest = float(np.nanmax(np.abs(values), initial=1e-12))
        limits = limits or ((-largest, largest) if kind == "error" else (0.0, 1.0))
        picture = _mapped(values, *limits, kind)
    show_image(axes, picture, title, size)
    colour_bar(axes, kind, limits, label)


def colour_bar(
    axes: Axes | Series[Axes],  # beside which it stands
    kind: str,  # "beta", "depth", "weight", or "error", which has a sign
    limits: Limits,
    label: str | None = None,  # None: the kind
) -> None:
    """Add the colour bar of pictures that are drawn in the colours of a kind."""
    norm = (LogNorm if kind == "beta" else Normalize)(*limits)
    colours, label = ScalarMappable(norm, _COLORMAPS[kind]), kind if label is None else label
    if isinstance(axes, Axes):  # as tall as the picture
        beside = axes.inset_axes((1.03, 0.0, 0.05, 1.0))
        bar = axes.figure.colorbar(colours, cax=beside, label=label)
    else:
        bar = axes[0].figure.colorbar(colours, ax=list(axes), label=label)
    if kind == "beta":  # 0.3, not 3 x 10^-1
        ticks = [tick for tick in _BETA_TICKS if limits[0] <= tick <= limits[1]]
        bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
        bar.minorticks_off()


def depth_to_rgb(depth: np.ndarray, limits: Limits | None = None) -> np.ndarray:  # RGB in [0, 1]
    """Colour a depth map (H, W) [world units]: viridis from near to far, grey where unknown (0)."""
    depth = np.asarray(depth, dtype=np.float64)
    known = np.isfinite(depth) & (depth > 0)
    low, high = limits or depth_limits(depth)
    colored = _mapped(np.where(known, depth, low), low, high, "depth")
    colored[~known] = _UNKNOWN_RGB
    return colored


def depth_limits(depth: np.ndarray) -> Limits:
    """Return the nearest and the farthest depth of the colours, for maps of any shape."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    low, high = np.quantile(known, _QUANTILES) if len(known) else (0.0, 1.0)
    return float(low), max(float(high), _LEAST_DEPTH_RATIO * float(low))


def beta_to_rgb(beta: np.ndarray, limits: Limits | None = None) -> np.ndarray:  # RGB in [0, 1]
    """Colour an uncertainty map (h, w) > 0: magma over log beta, dark is certain."""
    beta = np.asarray(beta, dtype=np.float64)
    low, high = limits or beta_limits(beta)
    return _mapped(np.log(np.maximum(beta, low)), np.log(low), np.log(high), "beta")


def beta_limits(beta: np.ndarray) -> Limits:
    """Return the beta drawn darkest, at least 0.1, and the beta drawn brightest."""
    least = np.maximum(np.asarray(beta, dtype=np.float64), _LEAST_BETA)
    low, high = map(float, np.quantile(least, _QUANTILES))
    return low, max(high, _LEAST_BETA_RATIO * low, _BRIGHT_BETA)


def _mapped(values: np.ndarray, low: float, high: float, kind: str) -> np.ndarray:
    scaled = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    return colormaps[_COLORMAPS[kind]](scaled)[..., :3]
