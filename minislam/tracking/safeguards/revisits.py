"""Find a loop that drift hides: the camera is back at a place, and its pose says it is elsewhere.

`loop_closure.py` looks where the present geometry predicts a loop. After a long way the drift can
be larger than what two images have in common. Then a keyframe is looked for among much older ones
as a lost frame is (`relocalisation.py`). The pose found there differs from the present one by the
drift, a similarity, which is spread evenly over the way. From there the geometry predicts the loop.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_exp, se3_inverse, se3_log, so3_log
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.safeguards.relocalisation import Place, Relocaliser
from minislam.tracking.safeguards.robust import weighted_median

EVERY = 2  # keyframes from one search to the next: several see the same place
MOST_DRIFT = 0.1  # of the way walked, and of the angle turned: more is another place [-]


def undo_drift(graph: KeyframeGraph, relocaliser: Relocaliser) -> bool:
    """If the newest keyframe shows an earlier place, move those since then; tell whether it did.

    Only every second keyframe is asked. The caller checks what the flow says of the new poses.
    """
    keyframes, newest = graph.keyframes, len(graph.keyframes) - 1
    older = newest - graph.config.loop_min_gap
    if older < 1 or newest % EVERY:
        return False
    seen = keyframes.frames[newest].image, keyframes.features[newest]
    place = relocaliser.find(*seen, older)
    if place is None or not _is_likely(place, keyframes.T_camera_world):
        return False
    scale = _scale_drift(graph, place)
    geometry = keyframes.T_camera_world, keyframes.disparities
    keyframes.set_geometry(*spread(*geometry, place.keyframe_index, place.T_camera_world, scale))
    return True


def _is_likely(place: Place, T_camera_world: Tensor) -> bool:
    """Tell whether the drift is small for the way since then; else both places look alike."""
    way = T_camera_world[place.keyframe_index :]
    walked, turned = _motion(way[1:], way[:-1])
    missed, misturned = _motion(place.T_camera_world[None], way[-1:])
    return missed <= MOST_DRIFT * walked and misturned <= MOST_DRIFT * turned


def _motion(first: Tensor, second: Tensor) -> tuple[float, float]:  # 2 x (K, 4, 4)
    """Return the sums of distances [world units] and angles [rad] between cameras."""
    motions = first @ se3_inverse(second)
    lengths = motions[:, :3, 3].norm(dim=-1), so3_log(motions[:, :3, :3]).norm(dim=-1)
    return float(lengths[0].sum()), float(lengths[1].sum())


def _scale_drift(graph: KeyframeGraph, place: Place) -> float:
    """Return by what the newest keyframe's depths are too small, against the old one's."""
    expected = graph.warp_disparities(place.keyframe_index, place.T_camera_world)
    found, weights = graph.keyframes.disparities[-1], graph.keyframes.cell_weights[-1]
    ratio = found / expected.clamp_min(1e-6)
    return weighted_median(ratio, weights * (expected > 0) * (found > 0)) or 1.0


def spread(
    T_camera_world: Tensor,  # (K, 4, 4)
    disparities: Tensor,  # (K, N)
    old: int,  # keyframe; it and those before it stay
    T_newest_world: Tensor,  # (4, 4), where the last keyframe belongs
    scale: float,  # by what its depths, and the last step, are too small
) -> tuple[Tensor, Tensor]:
    """Return poses and disparities with the drift spread evenly over the keyframes since `old`.

    First the steps grow, by scale^a at the fraction a of the way. Then what is left at its end, C
    in the coordinates of the old camera, moves each camera by the fraction a of C.
    """
    count = len(disparities) - 1 - old
    steps = torch.arange(1, count + 1, device=T_camera_world.device)
    fractions = steps[:, None].to(T_camera_world) / count
    growth = scale**fractions
    T_old_camera = T_camera_world[old] @ se3_inverse(T_camera_world[old:])
    T_old_camera[1:, :3, 3] = (growth * T_old_camera[:, :3, 3].diff(dim=0)).cumsum(0)
    target = T_camera_world[old] @ se3_inverse(T_newest_world)
    correction = se3_log(target @ se3_inverse(T_old_camera[-1]))
    moved = se3_exp(fractions * correction) @ T_old_camera[1:]
    poses, disparities = T_camera_world.clone(), disparities.clone()
    poses[old + 1 :] = se3_inverse(moved) @ T_camera_world[old]
    disparities[old + 1 :] /= growth.to(disparities)
    return poses, disparities
