"""The truth that lies beside a recording, at the working size."""

from collections.abc import Callable

import numpy as np

from minislam.data.images import read_color, read_mask
from minislam.data.preparation import ImagePreparation
from minislam.data.recording import Recording
from minislam.records import Trajectory


class RecordedTruth:
    """What a benchmark knows and the system must not see: a `minislam.records.GroundTruth`."""

    def __init__(
        self,
        recording: Recording,
        prepare: ImagePreparation,
        source_index: Callable[[int], int],  # of a frame: its position in the recording
        sensor_depth: Callable[[int], np.ndarray | None],  # of a frame
    ) -> None:
        self.trajectory: Trajectory | None = recording.trajectory
        self._recording, self._prepare = recording, prepare
        self._source_index, self._sensor_depth = source_index, sensor_depth

    def moving_mask(self, frame_index: int) -> np.ndarray | None:
        """Return (H, W) bool, True where a mover is seen."""
        path = self._recording.mask_path(self._source_index(frame_index))
        return None if path is None else self._prepare.nearest(read_mask(path), str(path))

    def static_image(self, frame_index: int) -> np.ndarray | None:
        """Return (H, W, 3) float32: the same view without the movers and their shadows."""
        path = self._recording.static_path(self._source_index(frame_index))
        return None if path is None else self._prepare.color(read_color(path), str(path))

    def depth(self, frame_index: int) -> np.ndarray | None:
        """Return (H, W) float32 z-depth of what the camera saw, 0 where unknown."""
        return self._sensor_depth(frame_index)

    def novel_views(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return held-out static views as (T_world_camera (4, 4), image (H, W, 3)); may be []."""
        views = self._recording.novel_views
        return [(pose, self._prepare.color(read_color(path), str(path))) for pose, path in views]
