"""A wall seen by a moving camera: every pose, disparity and flow is known in closed form.

In an image of a plane the disparity is linear in the pixel, so interpolating between grid cells
is exact.
"""

import torch
from torch import Tensor

from minislam.geometry import se3_inverse
from minislam.priors.interfaces import FlowChain, FlowMatches
from minislam.records import Frame
from minislam.tracking.config import TrackingConfig
from minislam.tracking.grid import Grid
from minislam.tracking.keyframe_graph import KeyframeGraph
from minislam.tracking.reprojection import relative_transforms, reproject
from tests.tracking.scene import CAMERA, STRIDE, poses_on_an_arc

NORMAL, DISTANCE = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64), 4.0  # n . p_world = d
GRID = Grid.of(CAMERA, STRIDE)
FRAMES = 12


def true_poses() -> Tensor:  # (FRAMES, 4, 4)
    return poses_on_an_arc(FRAMES, seed=4)


def disparities_at(T_camera_world: Tensor, rays: Tensor) -> Tensor:  # (..., 3) -> (...)
    """Return 1 / z of the wall along rays with z = 1."""
    T_world_camera = se3_inverse(T_camera_world)
    direction, origin = T_world_camera[:3, :3], T_world_camera[:3, 3]
    return (rays.double() @ direction.T @ NORMAL) / (DISTANCE - origin @ NORMAL)


def wall_frame(number: int) -> Frame:
    """Return a frame whose image says which one it is: that is all `TrueFlow` looks at."""
    return Frame(number, 0.1 * number, torch.full((CAMERA.height, CAMERA.width, 3), float(number)))


class TrueFlow:
    """Flow as the geometry says, wherever it is asked to start from."""

    stride = STRIDE

    def __init__(
        self, ratios: dict[tuple[int, int], float] | None = None, is_learned: bool = False
    ) -> None:
        self.learned_confidence = is_learned
        self.numbers: dict[int, int] = {}  # of the frame that a keyframe is
        self.ratios = ratios or {}  # of edges that are not matched as a whole

    def add_frame(self, keyframe_index: int, image: Tensor) -> None:
        self.numbers[keyframe_index] = int(image[0, 0, 0])

    def remove_frame(self, keyframe_index: int) -> None:
        del self.numbers[keyframe_index]

    def match(self, sources: list[int], targets: list[int], predicted: Tensor) -> FlowMatches:
        assert predicted.shape == (len(sources), 2, len(GRID.rays)), predicted.shape
        poses = true_poses()
        source = [self.numbers[index] for index in sources]
        target = [self.numbers[index] for index in targets]
        disparities = torch.stack([disparities_at(poses[k], GRID.rays) for k in source])
        transforms = relative_transforms(poses, source, target)
        positions, valid = reproject(transforms, disparities, GRID.rays.double(), CAMERA)
        seen = valid & CAMERA.contains(positions.mT)
        confidences = seen[:, None].repeat(1, 2, 1).float()
        ratios = [self.ratios.get(edge, 1.0) for edge in zip(sources, targets, strict=True)]
        return FlowMatches(positions.float(), confidences, torch.tensor(ratios))

    def disparity_damping(self, keyframes: int) -> None:
        return None

    def start_chain(self, image: Tensor) -> FlowChain:
        raise NotImplementedError


def true_graph(
    numbers: list[int], config: TrackingConfig | None = None, flow: TrueFlow | None = None
) -> KeyframeGraph:
    """Return a keyframe graph of these frames, all of them where they truly are."""
    config = config or TrackingConfig()
    result = KeyframeGraph(CAMERA, config, flow or TrueFlow())
    for index, number in enumerate(numbers):
        frame, pose = wall_frame(number), true_poses()[number]
        disparities = disparities_at(pose, GRID.rays).float()
        features = torch.zeros(1, 1, 1)
        unknown = torch.zeros_like(disparities)
        result.keyframes.append(frame, features, None, pose, disparities, unknown)
        result.flow.add_frame(index, frame.image)
        if index > 0:
            result.flow_to_next.append(result.flow.match([index - 1], [index], GRID.pixels.T[None]))
    return result
