"""A run read back from its folder: camera, poses, map and beta, to render, plot and export."""

from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.linalg import det

from minislam.config import SlamConfig, settings_in, settings_of, with_settings
from minislam.data.files import Json, read_bytes, read_json, read_text
from minislam.data.images import is_image
from minislam.data.options import InputOptions
from minislam.data.ply import GaussianArrays, read_ply
from minislam.data.run_folder import CAMERA, CONFIG, MAP, PLOTS, VIEWER, RunFolder
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.errors import InputError, require
from minislam.geometry import Camera, se3_inverse
from minislam.images import resample
from minislam.mapping.mapper import surface_depth
from minislam.parameters import with_values
from minislam.priors.choice import PriorChoice, choose_features
from minislam.priors.features import HighResolutionFeatures
from minislam.priors.flow import STRIDE
from minislam.priors.interfaces import FeatureExtractor
from minislam.records import Trajectory
from minislam.runs.facts import unit_of
from minislam.runs.progress import quoted
from minislam.runs.resume import way_on
from minislam.runs.summary import Line, summarise
from minislam.runs.warnings import BROKEN
from minislam.slam import Slam
from minislam.splatting import GaussianMap, Rendering, render
from minislam.tracking.grid import Grid
from minislam.tracking.safeguards.exposure import exposure_at
from minislam.tracking.safeguards.rolling_shutter import ImageMotion
from minislam.uncertainty import UncertaintyMLP, beta_of_mask
from minislam.uncertainty.weights import MAPPING_CUT
from minislam.viz import Figure, Page, overview, summary_html


@dataclass(frozen=True)
class SourceFrame:
    """Where a frame of a run comes from."""

    index: int  # position in the run: 0, 1, 2, ...
    timestamp: float  # second
    source: str  # name of its image file, or of its video with the number in it
    keyframe: bool
    exposure: list[float] | None = None  # brightness over the map's; None: it is constant
    mapped: bool = True  # of a broken run: in the piece that the map shows


def scene_of(slam: Slam) -> Json:
    """Return the content of camera.json: what it takes to render the map as the run did."""
    sequence, keyframes = slam.sequence, {f.frame_index for f in slam.tracker.keyframes.frames}
    name = sequence.source_name
    mapped = slam.tracker.watch.longest_piece(slam.poses) or range(len(slam.tracker.tracked))
    frames, exposures = [], slam.mapper.exposures
    for i, tracked in enumerate(slam.tracker.tracked):
        exposure = exposure_at(i, exposures)
        level = None if exposure is None else exposure.tolist()
        row = i, tracked.timestamp, name(i), i in keyframes, level, i in mapped
        frames.append(asdict(SourceFrame(*row)))
    return {
        "sequence": {"name": sequence.name, "description": sequence.description},
        "camera": asdict(slam.tracker.grid.camera),
        "unit": unit_of(slam),
        "background": slam.mapper.background.tolist(),
        "least_weight": slam.mapper.least_weight,
        "preparation": sequence.preparation,
        "frames": frames,
    }


class Run:
    """A run on disk: poses are T_world_camera (4, 4), images are RGB in [0, 1].

    The camera's axes: x right, y down, z forward; the centre of the first pixel is (0, 0).
    What is not in the folder, the input images, is read from the source again.
    """

    def __init__(self, folder: Path | str) -> None:
        """Read the folder of a run that has a map."""
        self.folder = RunFolder(folder)
        path = self.folder.path / CAMERA
        if not path.is_file():
            advice, config = "give the --output of a finished run", self.folder.path / CONFIG
            if config.is_file():
                advice += f", or repeat it: minislam run --config {quoted(str(config))}"
            found = f"expected a run with a map in {folder}, found no camera.json"
            raise InputError(f"{found}; {way_on(folder) or advice}")
        scene = read_json(path)
        try:
            self.name: str = scene["sequence"]["name"]
            self.camera = Camera(**scene["camera"])
            self.unit: str = scene["unit"]
            self.background = np.array(scene["background"], np.float32).reshape(3)
            self.least_weight = float(scene.get("least_weight", MAPPING_CUT))  # of a static pixel
            self.frames = [SourceFrame(**frame) for frame in scene["frames"]]
        except (KeyError, TypeError, ValueError) as error:
            found = f"{error!r} in {path}; repeat the run, or restore the file"
            raise InputError(f"expected camera.json of a run, found {found}") from error
        self._betas: dict[int, Tensor] = {}  # raw beta (h', w') of frames asked for so far
        self.trajectory: Trajectory = self.folder.read_trajectory()
        self.gaussians: GaussianArrays = read_ply(self.folder.path / MAP)

    @cached_property
    def config(self) -> SlamConfig:
        """Return the settings of the run, without those that an older version had."""
        given, known = settings_in(self.folder.read_config()), settings_of(SlamConfig())
        kept = {name: value for name, value in given.items() if name in known}
        return with_settings(SlamConfig(), kept)

    @cached_property
    def poses(self) -> dict[int, np.ndarray]:
        """Return T_world_camera (4, 4) of the frames that have a pose, by frame index.

        Of a broken run, those of the piece that the map shows; `trajectory` has all.
        """
        rows = zip(self.trajectory.timestamps, self.trajectory.T_world_camera, strict=True)
        # In whole microseconds, as the file was written; round(stamp, 6) rounds 1e9 s otherwise.
        found = {round(1e6 * stamp): pose for stamp, pose in rows}
        shown = [frame for frame in self.frames if frame.mapped]
        stamps = {frame.index: round(1e6 * frame.timestamp) for frame in shown}
        return {index: found[stamp] for index, stamp in stamps.items() if stamp in found}

    @property
    def keyframes(self) -> list[int]:
        """Return the frame indices of the keyframes, like `poses`."""
        return [frame.index for frame in self.frames if frame.mapped and frame.keyframe]

    @property
    def warnings_of_breaks(self) -> list[str]:
        """Return the warnings in run.json that say where the trajectory is broken."""
        return [text for text in self.folder.read_run()["warnings"] if text.startswith(BROKEN)]

    def render(
        self,
        T_world_camera: np.ndarray,
        camera: Camera | None = None,  # None: the run's
        exposure: list[float] | None = None,  # of one of `frames`; None: as bright as the map
    ) -> np.ndarray:  # (H, W, 3)
        """Return the colours of the map, seen from a pose."""
        color = self._rendering(T_world_camera, camera).color
        return (color * torch.tensor(exposure or 1.0)).clamp(0, 1).numpy()

    def render_depth(
        self, T_world_camera: np.ndarray, camera: Camera | None = None
    ) -> np.ndarray:  # (H, W)
        """Return the z-depth of the visible surface [unit], 0 where the map is transparent."""
        return surface_depth(self._rendering(T_world_camera, camera)).numpy()

    def beta(self, frame_index: int) -> np.ndarray:  # (H, W)
        """Return the uncertainty of any frame by the final MLP; without uncertainty it is 1."""
        wanted = f"a frame of the run, 0 to {len(self.frames) - 1}"
        require(frame_index in range(len(self.frames)), wanted, f"{frame_index}; choose one")
        height, width = self.camera.height, self.camera.width
        settings, sequence = self.config.uncertainty, self.sequence
        if not settings.enabled:
            return np.ones((height, width), np.float32)
        mask = sequence.given_mask(frame_index) if settings.given_masks else None
        if mask is not None:
            return beta_of_mask(torch.from_numpy(mask)).numpy()
        if frame_index not in self._betas:  # a network may take seconds for the features
            with torch.no_grad():
                self._betas[frame_index] = self._mlp(self._features(sequence.frame(frame_index)))
        return resample(self._betas[frame_index], height, width).numpy()

    def displacement(self, frame_index: int) -> np.ndarray | None:  # (H, W, 2) px
        """Return how far a rolling shutter shows each pixel from its place; None: negligibly."""
        across, down = self.folder.read_run().get("readout_seconds", (0.0, 0.0))
        is_global = across == down == 0
        return None if is_global else self._motion.displacement(frame_index, (across, down))

    def plot(self, frame_index: int | None = None) -> Figure:
        """Draw the run: a frame (by default the middle keyframe) and the path."""
        index = self.keyframes[len(self.keyframes) // 2] if frame_index is None else frame_index
        if index not in self.poses:
            raise InputError(f"expected a frame of the map, found {index}; choose one of run.poses")
        image = self.sequence.frame(index).image.numpy()
        color = self.render(self.poses[index], exposure=self.frames[index].exposure)
        stamps, breaks = [f.timestamp for f in self.frames], self.folder.read_run()["breaks"]
        broken = [(stamps[b["first_frame"]], stamps[b["last_frame"]]) for b in breaks]
        return overview(image, self.beta(index), color, self.trajectory, None, self.unit, broken)

    def view(self, height: int = 620) -> Page:  # px
        """Return the map to turn with the mouse, as the output of a notebook's cell."""
        return Page(read_text(self.folder.path / VIEWER), height)

    def summary(self) -> list[Line]:
        """Return what is known of the run in words, with units and verdicts."""
        return summarise(self.folder.read_metrics(), self.folder.read_run())

    def __repr__(self) -> str:
        poses = f"{len(self.trajectory)} of {len(self.frames)} frames with a pose"
        size = f"{len(self.keyframes)} keyframes, {len(self.gaussians)} Gaussians"
        return f"Run of {self.name}: {poses}, {size}; {self.folder.path.name}"

    def _repr_html_(self) -> str:
        png = read_bytes(self.folder.path / PLOTS / "overview.png")
        return summary_html(self.name, self.summary(), self.folder.read_run()["warnings"], png)

    @cached_property
    def sequence(self) -> RecordedSequence:
        """Return the source of the run, opened again."""
        source, options = (self.folder.read_config()[part] for part in ("sequence", "input"))
        sequence = open_sequence(source, with_values(InputOptions(), options))
        wanted = f"the {len(self.frames)} frames of the run in {source}"
        require(len(sequence) >= len(self.frames), wanted, f"{len(sequence)}; restore the source")
        for frame in self.frames:
            found = sequence.source_name(frame.index)
            is_right = found == frame.source or not is_image(Path(found))  # videos may be renamed
            wanted = f"{frame.source} as frame {frame.index} of the run in {source}"
            require(is_right, wanted, f"{found}; restore the source")
        return sequence

    @cached_property
    def _features(self) -> FeatureExtractor:
        on_cpu = {"device": "cpu", "precision": "fp32"}
        choice = PriorChoice(**self.folder.read_config()["priors"] | on_cpu)
        features = choose_features(choice, self.sequence.camera, self.config.networks)
        return HighResolutionFeatures(features, self.config.uncertainty.grid_factor)

    @cached_property
    def _motion(self) -> ImageMotion:
        motion = ImageMotion(Grid.of(self.camera, STRIDE))
        for frame in self.frames:
            motion.see(self.sequence.frame(frame.index))
        return motion

    @cached_property
    def _mlp(self) -> UncertaintyMLP:
        settings = self.config.uncertainty
        generator = torch.Generator()  # of weights that are replaced at once
        mlp = UncertaintyMLP(self._features.dimension, generator, settings.hidden_units)
        mlp.load_state_dict(self.folder.read_mlp())
        return mlp

    def _rendering(self, T_world_camera: np.ndarray, camera: Camera | None) -> Rendering:
        is_pose = False
        with suppress(IndexError, RuntimeError, TypeError, ValueError):  # of another shape or kind
            pose = torch.from_numpy(np.asarray(T_world_camera, np.float64))
            T_camera_world, one = se3_inverse(pose), torch.eye(4, dtype=pose.dtype)
            is_pose = torch.allclose(pose @ T_camera_world, one, atol=1e-3) and bool(det(pose) > 0)
        if not is_pose or pose.shape != (4, 4):
            wanted = "T_world_camera (4, 4), a rotation and a position over 0 0 0 1"
            found = f"{' '.join(repr(T_world_camera).split())[:100]}; give one like run.poses"
            raise InputError(f"expected {wanted}, found {found}")
        background = torch.from_numpy(self.background)
        rows = {name: torch.from_numpy(values) for name, values in vars(self.gaussians).items()}
        anchors = torch.zeros(len(self.gaussians), dtype=torch.int64)
        gaussians = GaussianMap(**rows, anchor_keyframe=anchors)
        with torch.no_grad():
            return render(gaussians, camera or self.camera, T_camera_world, background)
