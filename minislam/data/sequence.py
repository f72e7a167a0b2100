"""Open a folder, a video, or a synthetic sequence by its name."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from zlib import crc32

import numpy as np
import torch

from minislam.data.calibration import Calibration, read_calibration, rough_calibration
from minislam.data.folder import read_image_folder, read_video
from minislam.data.images import read_depth, read_mask
from minislam.data.kept_images import KeptImages
from minislam.data.options import SYNTHETIC, InputOptions, require_source, synthetic_parts
from minislam.data.preparation import ImagePreparation
from minislam.data.recording import RecordedTruth, Recording, mask_files, path_of
from minislam.data.tum import is_tum_folder, read_tum_folder
from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.records import Frame, GroundTruth

_SYNTHETIC_SIZE = (320, 240)  # px


def open_sequence(
    source: str,
    options: InputOptions | None = None,
    progress: Callable[[int, int], None] | None = None,  # (done, of all) while rendering synth:
) -> "RecordedSequence":
    """Open a video, an image folder, a TUM RGB-D folder, or `synth:NAME[:SEED][?phone]`.

    A folder is recognised by its content, not by its name.
    """
    options = options or InputOptions()
    require_source(source)
    if source.startswith(SYNTHETIC):
        return _open_synthetic(source, options, progress)
    path = Path(source).expanduser()
    if path.is_file():
        last = None
        if options.max_frames is not None:
            last = options.start + options.stride * (options.max_frames - 1) + 1
        return RecordedSequence(read_video(path, last), options, source)
    recording = read_tum_folder(path) if is_tum_folder(path) else read_image_folder(path)
    return RecordedSequence(recording, options, source)


class RecordedSequence:
    """The chosen frames of a recording at the working size: a `minislam.records.Sequence`."""

    def __init__(self, recording: Recording, options: InputOptions, source: str) -> None:
        self._recording = recording
        self.depth_scale = options.depth_scale
        if not source.startswith("synth:"):  # so that it is found again from any folder
            source = str(Path(source).expanduser().absolute())
        self.opened_as = {"sequence": source, "input": asdict(options)}
        chosen = range(options.start, len(recording.images), options.stride)
        self._chosen = chosen[: options.max_frames]
        if len(self._chosen) == 0:
            raise InputError(
                f"expected frames from number {options.start} on, but {recording.name} has "
                f"{len(recording.images)}; choose a smaller start"
            )
        stamps = recording.timestamps[self._chosen.start : self._chosen.stop : self._chosen.step]
        if np.any(np.diff(np.round(stamps, 6)) <= 0):
            raise InputError(
                f"expected timestamps at least a microsecond apart, found closer ones in "
                f"{recording.name}; name the images by seconds, or by numbers from 0"
            )
        self.lost = [row for row in recording.lost if stamps[0] < row[0] < stamps[-1]]
        self.checksums: dict[int, int] = {}
        self._kept = KeptImages()
        self.files = recording.images.paths  # of all images
        self._masks = recording.mask_paths
        if options.masks is not None:
            self._masks = mask_files(recording.images, options.masks, self._chosen)
        height, width = recording.images.read(self._chosen[0]).shape[:2]
        calibration = _calibration(recording, options, width, height)
        raw_camera = calibration.camera_for(width, height)
        self._prepare = ImagePreparation(
            raw_camera, calibration.distortion, options.size, options.pixels
        )
        self.name = recording.name
        self.camera = self._prepare.camera
        self.preparation = self._prepare.steps()
        self.warnings = list(recording.warnings)
        self.refines_focal = options.focal == "refine"
        if options.focal == "auto":
            self.refines_focal = calibration.is_rough
        if calibration.is_rough and not self.refines_focal:
            self.warnings.append(
                f"the focal length is unknown: {calibration.fx:.0f} px, {calibration.origin}, for "
                f"{width}x{height} images, trajectory and map may be bent; give --fx, a "
                "calibration file, or --focal refine"
            )
        size = f"{width}x{height} -> {self.camera.width}x{self.camera.height} px"
        counts = f"{len(self)} of {len(recording.images)} images"
        parts = [counts, *recording.notes, size, calibration.origin]
        if options.masks is not None:
            parts.append(f"masks from {options.masks}")
        if self.refines_focal:
            parts.append("focal length to be refined")
        self.description = f"{recording.kind}: {', '.join(parts)}"
        self.ground_truth: GroundTruth | None = None
        if recording.has_truth():
            self.ground_truth = RecordedTruth(
                recording, self._prepare, self.source_index, self.sensor_depth
            )

    def __len__(self) -> int:
        return len(self._chosen)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(frame_index) for frame_index in range(len(self)))

    def frame(self, frame_index: int) -> Frame:
        """Return one frame; timestamps are those of the source, whatever the stride."""
        index = self.source_index(frame_index)

        def prepare() -> np.ndarray:
            raw = self._recording.images.read(index)
            self.checksums[frame_index] = crc32(raw.tobytes())
            return self._prepare.pixels(raw, self._recording.images.label(index))

        pixels = torch.from_numpy(self._kept.get(frame_index, prepare))
        return Frame(frame_index, float(self._recording.timestamps[index]), pixels)

    def full_image(self, frame_index: int) -> np.ndarray:  # (H, W, 3) uint8 RGB
        """Return one frame undistorted, at the size of the source; `full_camera` belongs to it."""
        index = self.source_index(frame_index)
        images = self._recording.images
        return self._prepare.full_color(images.read(index), images.label(index))

    def full_camera(self, camera: Camera) -> Camera:
        """Return the camera of `full_image` from that of the working images."""
        return self._prepare.full_camera(camera)

    def source_index(self, frame_index: int) -> int:
        """Return the position of a frame in the source, before start and stride."""
        if not 0 <= frame_index < len(self):
            raise IndexError(f"frame {frame_index} of a sequence of {len(self)}")
        return self._chosen[frame_index]

    def source_name(self, frame_index: int) -> str:
        """Return the name of a frame's image file, or of its video with the number in it."""
        return self._recording.images.name(self.source_index(frame_index))

    def given_mask(self, frame_index: int) -> np.ndarray | None:
        """Return the mask (H, W) bool of --masks, else the recording's own; True: it moves."""
        path = path_of(self._masks, self.source_index(frame_index))
        return None if path is None else self._prepare.nearest(read_mask(path), str(path))

    def sensor_depth(self, frame_index: int) -> np.ndarray | None:
        """Return the depth sensor's z-depth (H, W) float32 [m], 0 where unknown, or None."""
        path = path_of(self._recording.depth_paths, self.source_index(frame_index))
        if path is None:
            return None
        return self._prepare.nearest(read_depth(path, self.depth_scale), str(path))


def _calibration(
    recording: Recording, options: InputOptions, width: int, height: int
) -> Calibration:
    """Return the calibration of raw images of this size.

    The options come before files, files before known cameras, known cameras before what the
    camera noted in its files, that before the guess.
    """
    found = read_calibration(Path(options.calibration)) if options.calibration else None
    found = found or recording.calibration
    calibration = found or rough_calibration(width, height, recording.noted_focal_length)
    fy = options.fx if options.fy is None else options.fy
    given = {"fx": options.fx, "fy": fy, "cx": options.cx, "cy": options.cy}
    given = {name: value for name, value in given.items() if value is not None}
    if given:
        scaled = calibration.camera_for(width, height)
        base = {name: getattr(scaled, name) for name in ("fx", "fy", "cx", "cy")}
        origin = f"{' '.join(given)} given, {calibration.origin}"
        if found is None and options.fx is not None:
            origin = "intrinsics given"
        calibration = replace(calibration, **(base | given), size=(width, height), origin=origin)
        calibration = replace(calibration, is_rough=calibration.is_rough and options.fx is None)
    return calibration


def _open_synthetic(
    source: str, options: InputOptions, progress: Callable[[int, int], None] | None
) -> RecordedSequence:
    """Render a synthetic sequence, or take it from the cache, and open it."""
    import data_synth  # only here: real footage needs no scene generator

    name, seed, is_filmed = synthetic_parts(source)
    phone = data_synth.Phone() if is_filmed else None
    frames = data_synth.default_frames(name)
    if options.max_frames is not None:
        frames = options.start + options.stride * options.max_frames
    size = options.size or _SYNTHETIC_SIZE
    try:
        folder = data_synth.cached_sequence(name, int(seed or 0), frames, size, progress, phone)
    except (data_synth.SynthError, OSError) as error:
        raise InputError(
            f"expected to render {source} into the cache, but: {error}; set MINISLAM_CACHE to a "
            "folder that is writable and has space left"
        ) from error
    recording = replace(
        read_tum_folder(folder),
        name=f"{name}-{seed or 0}{'-phone' if is_filmed else ''}",
        kind=f"synthetic sequence {name}{', filmed by a phone' if is_filmed else ''}",
    )
    return RecordedSequence(recording, options, source)
