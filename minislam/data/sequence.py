"""Open a folder, a video, or a synthetic sequence by its name."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from zlib import crc32

import numpy as np
import torch

from minislam.data.calibration import Calibration, read_calibration, rough_calibration
from minislam.data.files import read_bytes
from minislam.data.images import read_color, read_depth, read_mask
from minislam.data.options import SYNTHETIC, InputOptions, require_source, synthetic_parts
from minislam.data.picture import Window, first_of_two, picture_window
from minislam.data.preparation import ImagePreparation
from minislam.data.raw_images import FileImages
from minislam.data.sources import Recording, mask_files, read_image_folder, read_video
from minislam.data.tum import is_tum_folder, read_tum_folder
from minislam.errors import InputError, require
from minislam.parameters import absolute_path, user_path, with_values
from minislam.records import Frame, GroundTruth, Progress
from minislam.state.memory import Shelf, release

Reader = Callable[[Path], np.ndarray]  # of an image file
_SYNTHETIC_SIZE = (320, 240)  # px


def open_sequence(
    source: str | Path, options: InputOptions | None = None, progress: Progress | None = None
) -> "RecordedSequence":
    """Open a video, an image folder, a TUM RGB-D folder, or `synth:NAME[:SEED][?phone]`.

    A folder is recognised by its content. `progress` is called while a scene is rendered.
    """
    source, options = str(source), with_values(InputOptions(), vars(options or InputOptions()))
    require_source(source, options.masks)
    if source.startswith(SYNTHETIC):
        return _synthetic(source, options, progress)
    path = user_path(source)
    if path.is_file():
        last = None
        if options.max_frames is not None:
            last = options.start + options.stride * (options.max_frames - 1) + 1
        recording = read_video(path, last)
    else:
        recording = read_tum_folder(path) if is_tum_folder(path) else read_image_folder(path)
    return RecordedSequence(recording, options, source)


class RecordedSequence:
    """The chosen frames of a recording at the working size: a `minislam.records.Sequence`."""

    def __init__(self, recording: Recording, options: InputOptions, source: str) -> None:
        masks, lens = (p and absolute_path(p) for p in (options.masks, options.calibration))
        options = replace(options, masks=masks, calibration=lens)
        self._recording, self._options, self._source = recording, options, source
        source = source if source.startswith(SYNTHETIC) else absolute_path(source)
        self.opened_as = {"sequence": source, "input": asdict(options)}
        self.name, images, stamps = recording.name, recording.images, recording.timestamps
        asked = range(options.start, len(images), options.stride)[: options.max_frames]
        self._chosen = [index for index in asked if index not in images.odd]
        sizes = [*self._doubtful_sizes(asked)]
        found = f"{len(self._chosen)} among {len(images)} images of {recording.name}"
        advice = "after --start, --stride and --max-frames; change these, or give more images"
        if len(self._chosen) < 2 <= len(asked):
            advice = f"as {sizes[0]}"
        require(len(self._chosen) >= 2, "at least two frames", f"{found} {advice}")
        first, last = stamps[asked[0]], stamps[asked[-1]]
        self.unread = [row for row in recording.unread if first < row[0] < last]
        self.unread += [(float(stamps[k]), images.odd[k]) for k in asked if k in images.odd]
        self._step = float(np.median(np.diff(stamps)))
        self._masks = recording.mask_paths
        if options.masks is not None:
            self._masks = mask_files(images, options.masks, self._chosen)
        self.files = [*images.paths, *self._masks.values()]
        self.read_depth: Reader = partial(read_depth, units_per_metre=options.depth_scale)
        self.checksums: dict[int, int] = {}
        self._shelf = Shelf()
        self._kept: dict[int, np.ndarray] = {}  # working images on the shelf, by frame index

        image = images.read(self._chosen[0])
        (height, width), largest = image.shape[:2], int(image.max())
        glances = images.glances  # reads files
        picture = barless = picture_window(glances, width, height)
        if not (recording.calibration or options.calibration):
            picture = first_of_two(barless, glances, width, height)
        calibration = _calibration(recording, options, width, height, picture)
        camera, distortion = calibration.camera_for(width, height), calibration.distortion
        self.prepare = ImagePreparation(camera, distortion, options.size, options.pixels, picture)
        self.camera, self.preparation = self.prepare.camera, self.prepare.steps
        refines = {"fixed": False, "refine": True, "auto": calibration.is_rough}
        self.refines_focal = refines[options.focal]
        is_guess = calibration.is_rough and recording.noted_focal_length is None
        self.focal_origin = "" if is_guess else calibration.origin
        knows_nothing = calibration.is_rough and options.k1 is None and options.k2 is None
        self.seeks_lens = knows_nothing and options.focal == "auto"
        self.warnings = [*recording.warnings, *sizes, *self._doubts(calibration, largest)]
        if picture != barless:
            self.warnings.append(
                "the images show two pictures that are alike, as of two eyes: the left or upper "
                "one is taken; if they show one, give a calibration file"
            )
        self.description = f"{recording.kind}: {', '.join(self._facts(calibration, picture))}"
        truth = GroundTruth(
            recording.trajectory,
            moving_mask=partial(self._image_of, recording.mask_paths, read_mask),
            static_image=partial(self._image_of, recording.static_paths, read_color),
            depth=self.sensor_depth,
            novel_views=self._novel_views,
        )
        files = recording.mask_paths or recording.static_paths or recording.novel_views
        has_truth = recording.trajectory is not None or files  # a sensor's depth is an input
        self.ground_truth = truth if has_truth else None

    def _doubtful_sizes(self, asked: range) -> Iterator[str]:
        """Yield how many of the images asked for are left out or resized, with one of each."""
        said = self._recording.images.odd, self._recording.images.resized
        odd, resized = ([of[index] for index in asked if index in of] for of in said)
        if odd:
            text = f"{len(odd)} of {len(asked)} images are left out because of their size"
            yield f"{text}, such as {odd[0]}; crop, turn or resize them"
        if resized:
            text = f"{len(resized)} of {len(asked)} images are resized to the size of most"
            yield f"{text}, such as {resized[0]}"

    def _doubts(self, calibration: Calibration, largest: int) -> Iterator[str]:
        """Yield what is likely a mistake in the first raw image or the focal length."""
        raw, label = self.prepare.raw_camera, self._recording.images.labels[self._chosen[0]]
        if label.lower().endswith(".png") and 0 < largest < 16:
            what = f"{label} is almost black, its largest value {largest} of 255"
            yield f"{what}: if it holds 10 or 12 bits in 16, multiply all images by 64 or 16"
        for name, focal in (("fx", raw.fx), ("fy", raw.fy)):
            angle = np.degrees(2 * np.arctan(max(raw.width, raw.height) / 2 / focal))
            if not (calibration.is_rough or 15 <= angle <= 130):  # degree
                means = f"{name} {focal:g} px means a field of view of {angle:.0f} degrees"
                unit = "in millimetres" if angle > 130 else "for larger images"
                yield f"{means}: check if it is {unit}"
                break
        if calibration.is_rough and not self.refines_focal:
            unknown = f"the focal length is unknown: {calibration.fx:.0f} px, {calibration.origin}"
            advice = "give --fx, a calibration file, or --focal refine"
            size = f"for {raw.width}x{raw.height} images"
            yield f"{unknown}, {size}, trajectory and map may be bent; {advice}"

    def _facts(self, calibration: Calibration, picture: Window) -> Iterator[str]:
        """Yield what the description says of images and camera."""
        yield f"{len(self)} of {len(self._recording.images)} images"
        yield from self._recording.notes
        raw, (_, _, *seen) = self.prepare.raw_camera, picture
        is_cut = seen != [raw.width, raw.height]
        cut = f"cut to {seen[0]}x{seen[1]}, " if is_cut else ""
        yield f"{cut}{raw.width}x{raw.height} -> {self.camera.width}x{self.camera.height} px"
        yield calibration.origin
        if self._options.masks is not None:
            yield f"masks from {self._options.masks}"
        if self.refines_focal:
            yield "focal length to be refined"

    def __len__(self) -> int:
        return len(self._chosen)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(frame_index) for frame_index in range(len(self)))

    def frame(self, frame_index: int) -> Frame:
        """Return one frame; timestamps are those of the source, whatever the stride.

        A run looks at a frame about six times, and a video is slow in any other order than its own:
        so the working images are kept in a temporary file, until the disk is full.
        """
        index = self._chosen[frame_index]
        if frame_index in self._kept:
            image = self._kept[frame_index].copy()
        else:
            raw = self._recording.images.read(index)
            image = self.prepare.pixels(raw, self._recording.images.labels[index])
            files = (paths.get(index) for paths in (self._masks, self._recording.depth_paths))
            beside = b"".join(map(read_bytes, filter(None, files)))
            self.checksums[frame_index] = crc32(image.tobytes() + beside)
            with suppress(OSError):  # of a full disk: the image is prepared again next time
                place = self._shelf.reserve(image.nbytes).reshape(image.shape)
                place[:] = image
                self._kept[frame_index] = place
        release()
        stamp = float(self._recording.timestamps[index])
        return Frame(frame_index, stamp, torch.from_numpy(image), step=self._step)

    def through_lens(self, fx: float, k1: float, k2: float) -> "RecordedSequence":
        """Return the sequence, straightened: fx [px] is of the working size, fy in proportion."""
        raw, zoom = self.prepare.raw_camera, fx / self.camera.fx
        fx, fy = zoom * raw.fx, zoom * raw.fy
        options = replace(self._options, fx=fx, fy=fy, k1=k1, k2=k2, focal="refine")
        return RecordedSequence(self._recording, options, self._source)

    def full_image(self, frame_index: int) -> np.ndarray:  # (H, W, 3) uint8 RGB
        """Return one frame undistorted, at the size of the source: `prepare.full_camera`."""
        index = self._chosen[frame_index]
        images = self._recording.images
        return self.prepare.undistort(images.read(index), images.labels[index])

    def source_name(self, frame_index: int) -> str:
        return self._recording.images.names[self._chosen[frame_index]]

    def source_index(self, frame_index: int) -> int:
        return self._chosen[frame_index]

    def given_mask(self, frame_index: int) -> np.ndarray | None:
        """Return the mask (H, W) bool of --masks, else the recording's own; True: it moves."""
        return self._image_of(self._masks, read_mask, frame_index)

    def sensor_depth(self, frame_index: int) -> np.ndarray | None:
        return self._image_of(self._recording.depth_paths, self.read_depth, frame_index)

    def _image_of(self, paths: dict[int, Path], read: Reader, frame: int) -> np.ndarray | None:
        """Return the mask, depth or image of a file beside a frame, None if there is none."""
        images, index = self._recording.images, self._chosen[frame]
        if (path := paths.get(index)) is None:
            return None
        raw = read(path)
        if isinstance(images, FileImages):
            raw = images.as_usual(index, raw)
        return (self.prepare.color if raw.ndim == 3 else self.prepare.nearest)(raw, str(path))

    def _novel_views(self) -> list[tuple[np.ndarray, np.ndarray]]:
        views, prepare = self._recording.novel_views, self.prepare
        return [(pose, prepare.color(read_color(path), str(path))) for pose, path in views]


def _calibration(
    recording: Recording, options: InputOptions, width: int, height: int, picture: Window
) -> Calibration:
    """Return the calibration of raw images of this size, which show a picture in a window.

    The options come before files, files before known cameras, known cameras before what the
    camera noted in its files, that before the guess.
    """
    found = recording.calibration
    if options.calibration:
        found = read_calibration(Path(options.calibration))
    knows_fx = found is not None or options.fx is not None
    require(knows_fx or options.fy is None, "--fx with --fy", "--fy alone; give both")
    calibration = found or rough_calibration(picture, recording.noted_focal_length)
    fy = options.fx if options.fy is None else options.fy
    given = {"fx": options.fx, "fy": fy, "cx": options.cx, "cy": options.cy}
    given = {name: value for name, value in given.items() if value is not None}
    radial = {"k1": options.k1, "k2": options.k2}
    bent = {name: value for name, value in radial.items() if value is not None}
    if not given and not bent:
        return calibration
    camera = calibration.camera_for(width, height)
    origin = f"{' '.join([*given, *bent])} given, {calibration.origin}"
    if found is None and options.fx is not None:
        origin = "intrinsics given"
    return replace(
        calibration,
        **{name: given.get(name, getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")},
        size=(width, height),
        distortion=replace(calibration.distortion, **bent),
        origin=origin,
        is_rough=calibration.is_rough and options.fx is None,
    )


def _synthetic(source: str, options: InputOptions, progress: Progress | None) -> RecordedSequence:
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
        cache = "; set MINISLAM_CACHE to a writable folder with space left"
        advice = cache * isinstance(error, OSError)
        raise InputError(f"expected to render {source}, but: {error}{advice}") from error
    recording = replace(
        read_tum_folder(folder),
        name=f"{name}-{seed or 0}{'-phone' if is_filmed else ''}",
        kind=f"synthetic sequence {name}{', filmed by a phone' if is_filmed else ''}",
    )
    return RecordedSequence(recording, options, source)
