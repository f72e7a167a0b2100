"""Mapping (Sec. 3.4): a Gaussian map of the static scene, grown keyframe by keyframe.

Read the files in this order:

    mapper             when the map gets and loses Gaussians, and when it is optimised
    optimisation       one step of the map on L_render, and of the MLP on L_uncer
    views              images at several sizes; what one adds to a step, in any process
    losses             L_render, Eq. (6), and L_color, Eq. (7)
    insertion          where an image adds Gaussians, and which lie on dynamic objects
    window             the local window of keyframes, and which image each iteration renders
    deformation        the map follows its keyframes when bundle adjustment moves them
    pose_refinement    photometric refinement of the poses between the keyframes
    density            clone, split and prune
    gaps               ours: fills static surfaces whose depth no view has measured
    safeguards         ours: dynamic objects by the votes of other views and all betas of a clip
    config             the settings
"""

from minislam.mapping.config import InsertionConfig, MappingConfig
from minislam.mapping.mapper import Mapper

__all__ = ["InsertionConfig", "Mapper", "MappingConfig"]
