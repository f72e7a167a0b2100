"""Paint of one colour, so that the images of a scene are known."""

import numpy as np

from data_synth.textures import Texture, build_texture


def plain(red: float, green: float, blue: float) -> tuple[Texture]:
    """Return the texture of a part that has one colour all over."""
    return (build_texture(np.full((16, 16, 3), (red, green, blue), np.float32), 0.01),)
