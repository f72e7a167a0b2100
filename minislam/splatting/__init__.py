"""Gaussian splatting (Sec. 3.1): the map, and a renderer with every derivative written out.

Read the files in this order, the slow twin first:

    constants.py    what both renderers share
    gaussians.py    the map, and the Adam that optimises it
    reference.py    the slow twin: Eq. (1), Eq. (2) and Sigma' as the paper writes them
    covariance.py   Sigma = L L^T from quaternion and scales
    projection.py   mean and covariance from the world to the image
    visible.py      all steps of projection.py in a row, for the visible Gaussians, nearest first
    compositing.py  Eq. (1), Eq. (2) for a group of tiles
    tiles.py        which Gaussians touch which tile
    renderer.py     `render`: the whole chain over all tiles, as one differentiable function

Layout: a map, and everything in the slow twin, has one row per Gaussian, (N, 3). Inside the fast
renderer arrays are component-first, (3, N) and (3, 3, N): a component is one run of N numbers, and
its formula one fast pass over memory. `f_vjp`, right below `f`, pulls a gradient back through `f`.
"""

from minislam.splatting.constants import Rendering
from minislam.splatting.gaussians import GaussianMap, LearningRates, MapOptimizer
from minislam.splatting.reference import render_reference
from minislam.splatting.renderer import render

__all__ = [
    "GaussianMap", "LearningRates", "MapOptimizer", "Rendering", "render", "render_reference",
]  # fmt: skip
