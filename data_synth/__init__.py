"""A synthetic stand-in for the Wild-SLAM motion-capture sequences, with everything known.

An independent ray-caster renders two furnished rooms, the people and things that move in them, and
a hand-held camera; it shares no code with the package that is tested on it.

    sequence = generate("crowd", seed=7, frames=40)
    folder = cached_sequence("crowd", 7, 100, (320, 240))     # TUM RGB-D layout on disk
"""

from .errors import SynthError
from .phone import Phone, film, phone_intrinsics, write_video
from .poses import Intrinsics, default_intrinsics
from .scenes import SEQUENCES, SUMMARIES, Scene, default_frames, scene
from .sequence import SyntheticFrame, SyntheticSequence, generate, render_frame, render_view
from .writing import cached_sequence, write_sequence

__all__ = [
    "SEQUENCES",
    "SUMMARIES",
    "Intrinsics",
    "Phone",
    "Scene",
    "SynthError",
    "SyntheticFrame",
    "SyntheticSequence",
    "cached_sequence",
    "default_frames",
    "default_intrinsics",
    "film",
    "generate",
    "phone_intrinsics",
    "render_frame",
    "render_view",
    "scene",
    "write_sequence",
    "write_video",
]
