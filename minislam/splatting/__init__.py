"""Gaussian splatting (Sec. 3.1): the map, and a renderer with every derivative written out."""

from minislam.splatting.gaussians import GaussianMap, LearningRates, MapOptimizer
from minislam.splatting.rasterizer import render
from minislam.splatting.reference import render_reference
from minislam.splatting.rendering import Rendering

__all__ = [
    "GaussianMap",
    "LearningRates",
    "MapOptimizer",
    "Rendering",
    "render",
    "render_reference",
]
