"""Mapping (Sec. 3.4): a Gaussian map of the static scene, grown keyframe by keyframe."""

from minislam.mapping.config import (
    DensityConfig,
    InsertionConfig,
    MappingConfig,
    PoseRefinementConfig,
    paper_mapping,
)
from minislam.mapping.losses import MappingHistory
from minislam.mapping.mapper import Mapper

__all__ = [
    "DensityConfig",
    "InsertionConfig",
    "Mapper",
    "MappingConfig",
    "MappingHistory",
    "PoseRefinementConfig",
    "paper_mapping",
]
