"""What the user must know of a run: at once when something goes wrong, and all of it at its end."""

import math
from collections.abc import Iterator
from itertools import dropwhile

import numpy as np

from minislam.errors import InputError
from minislam.evaluation.metrics import MAX_DIFFERENCE
from minislam.evaluation.trajectory import absolute_trajectory_error, doubt_of_units
from minislam.records import TrackingStatus
from minislam.runs.measures import guessed_depth, left_out, shown_static
from minislam.runs.summary import span
from minislam.slam import Slam
from minislam.tracking.safeguards.diagnostics import is_unexplained
from minislam.tracking.safeguards.focal_length import FocalLengthFit
from minislam.tracking.safeguards.lens import BentLens

# Of the static pixels, in the mean of the map's images [-]: 78 good runs show .94 to 1, a run with
# an inconsistent path .65.
LEAST_SHOWN = 0.75
# Of the images, in their mean [-]: where movers are gone and the room is whole, beta leaves out .02
# to .23; of a night crowd in rain, whose map has holes, .36.
MOST_LEFT_OUT = 0.3
NEARLY_ALL = 0.7  # of them: 187 runs have .59 and less, five that are wrong .80 and more
# Of the static pixels [-]: maps that are whole have .11 to .67, fog and lumps .65 to .96.
MOST_GUESSED = 0.7
LARGEST_CHANGE = 4.0  # of a focal length by the run, either way; lenses lie nearer to the guess [-]
BROKEN = "the trajectory is broken"  # how a warning of breaks begins
_FAR_APART = (
    "If the images lie far apart or out of order, give more from between them (a smaller "
    "--stride), with names in their order"
)
_ZOOMED = "the lens zoomed while it filmed, no focal length is right, and the trajectory is bent"


def alarms(slam: Slam) -> Iterator[str]:
    """Yield a warning if tracking is just lost, and if the flow contradicts the last keyframe."""
    tracked, diagnostics = slam.tracker.tracked, slam.tracker.watch.diagnostics
    followed = [frame.status.is_followed for frame in tracked[-2:]]
    if slam.tracker.initialised and followed == [True, False]:
        yield f"frame {tracked[-1].frame_index}: the camera is lost; it is sought among keyframes"
    if diagnostics and is_unexplained(diagnostics[-1]):
        yield (
            f"frame {diagnostics[-1].frame_index}: the estimated motion explains only "
            f"{diagnostics[-1].explained:.0%} of the optical flow; the trajectory may break here"
        )


def warnings(slam: Slam, depth: str = "none") -> Iterator[str]:  # depth: name of the prior
    """Yield what the user must know of a run."""
    yield from _input_warnings(slam)
    yield from _path_warnings(slam)
    yield from _map_warnings(slam)
    yield from _camera_warnings(slam)
    yield from _parallax_warnings(slam)
    yield from _prior_warnings(slam, depth)


def _input_warnings(slam: Slam) -> Iterator[str]:
    yield from slam.sequence.warnings
    if slam.undone_lens:
        yield str(BentLens(slam.undone_lens))
    truth = slam.sequence.ground_truth and slam.sequence.ground_truth.trajectory
    if truth and slam.tracker.initialised:
        doubt = doubt_of_units(estimate := slam.trajectory(), truth)
        try:
            absolute_trajectory_error(estimate, truth, max_difference=MAX_DIFFERENCE)
        except InputError as error:
            doubt = f"there is no ATE: {error}"
        yield from filter(None, [doubt])


def _path_warnings(slam: Slam) -> Iterator[str]:
    watch, graph, lost = slam.tracker.watch, slam.tracker.graph, len(slam.lost_frames())
    if lost:
        apart = _as_options(slam, _lost_stretches(slam))
        rest = f". If the film is cut there, run the rest by itself: {apart}" if apart else ""
        is_lost = any(frame.status is TrackingStatus.LOST for frame in slam.tracker.tracked)
        yield (
            f"{lost} of {len(slam.tracker.tracked)} frames could not be tracked and have no pose; "
            f"lost_frames.txt lists them{rest}{f'. {_FAR_APART}' if is_lost else ''}"
        )
    if watch.breaks:
        where = ", ".join(span(found.first_frame, found.last_frame) for found in watch.breaks)
        mapped, piece = watch.longest_piece(slam.poses), ""
        if len(mapped) < len(slam.poses):
            shown = _stretches(sorted(mapped), slam.config.tracking.warmup_keyframes)
            piece = f", so the map shows frames {' and '.join(span(*s) for s in shown)} alone"
        pieces = _as_options(slam, _followed_stretches(slam))
        anew = f"; run each piece anew, with the other options as here: {pieces}" if pieces else ""
        yield (
            f"{BROKEN} at frames {where}: motion or depth contradicts the images, there is too "
            "little parallax to carry the scale across, or the camera follows something that came "
            "into view. Before and after, scale and direction do not belong "
            f"together{piece}{anew}. {_FAR_APART}"
        )
    if graph.failed_adjustments:
        yield (
            f"{graph.failed_adjustments} of {graph.adjustments} bundle adjustments failed "
            "and changed nothing: their poses and depths stay as first guessed, so do not trust "
            "them; try more texture, slower motion, or a smaller --stride"
        )


def _map_warnings(slam: Slam) -> Iterator[str]:
    if has_large_holes(slam):
        least = slam.mapper.images[int(np.argmin(slam.mapper.shown))].frame_index
        yield (
            f"the map shows only {shown_static(slam):.0%} of what stands still, least in frame "
            f"{least}: no depth was confirmed elsewhere. The camera hardly moved, its path is "
            "wrong, or the scene has no texture; move the camera sideways, or give a depth prior"
        )
    hidden = left_out(slam) or 0.0
    if hidden > MOST_LEFT_OUT and slam.config.uncertainty.takes_masks:
        yield (
            f"the masks cover {hidden:.0%} of all pixels, which are neither in the map nor "
            "measured; check that they are white only where something moves"
        )
    elif hidden > MOST_LEFT_OUT:
        yield (
            f"beta takes {hidden:.0%} of all pixels for moving, so they are neither in the map nor "
            "measured. Look at the pictures of beta; if they are bright on what stands still, crop "
            "what is fixed to the camera, or try other --features or --no-uncertainty"
        )
    guessed = guessed_depth(slam) if slam.mapper.shown and slam.tracker.knows_depth else None
    if guessed is not None and guessed > MOST_GUESSED:
        yield (
            f"no view measured the depth of {guessed:.0%} of what stands still: it is filled from "
            "around, so the map can be wrong wherever the camera has not been; move sideways past "
            "more texture, or give a depth prior"
        )


def _lost_stretches(slam: Slam) -> list[tuple[int, int]]:
    """Return first and last of the best start that was given up, and of frames lost in a row."""
    start, tracked = slam.first_frame, slam.tracker.tracked
    tells_depth, count = start.worth
    is_given_up = tells_depth and tracked[start.best].status is TrackingStatus.GIVEN_UP
    frames = dropwhile(lambda frame: not frame.status.is_followed, tracked)
    given_up = [(start.best, start.best + count - 1)] if is_given_up else []
    return given_up + _stretches([f.frame_index for f in frames if not f.status.is_followed], gap=1)


def _followed_stretches(slam: Slam) -> list[tuple[int, int]]:
    """Return first and last frame of the stretches between breaks and longer losses."""
    lost = {f.frame_index for f in slam.tracker.tracked if not f.status.is_followed}
    followed = ({*range(first, last + 1)} - lost for first, last in slam.tracker.watch.segments)
    gap = slam.config.tracking.warmup_keyframes
    return [span for frames in followed for span in _stretches(sorted(frames), gap)]


def _stretches(frames: list[int], gap: int) -> list[tuple[int, int]]:
    """Return first and last of the frames that follow each other by at most `gap`."""
    parts = np.split(frames, np.flatnonzero(np.diff(frames) > gap) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts if len(part)]


def _as_options(slam: Slam, stretches: list[tuple[int, int]]) -> str:
    """Return the options that run each stretch by itself, of those with enough frames to start."""
    return ", or ".join(
        f"--start {slam.sequence.source_index(first)} --max-frames {last - first + 1}"
        for first, last in stretches
        if last - first + 1 >= slam.config.tracking.warmup_keyframes
    )


def _camera_warnings(slam: Slam) -> Iterator[str]:
    fit, graph, lens = slam.focal_length, slam.tracker.graph, slam.lens
    # The flow of a broken run fits whatever focal length.
    is_broken = slam.tracker.watch.breaks or slam.lost_frames() or graph.failed_adjustments
    other = fit if fit is not None and fit.is_doubtful and not is_broken else None
    is_unknown = graph.seeks_focal and graph.adjustments and not graph.focal_is_free
    if is_unknown and slam.tracker.knows_depth:  # a view at one depth needs none
        origin = "the lens that the flow fits" if slam.undone_lens else slam.sequence.focal_origin
        told = _told_by_flow(slam, other) if other else ""
        zoomed = "; if the lens zoomed, run each part for itself" if other and other.half else ""
        yield (
            f"the focal length is {f'known from {origin} alone' if origin else 'unknown'} "
            f"and the motion does not tell it{told}: trajectory and map may be bent; give --fx or "
            f"a calibration file{zoomed}"
        )
        return
    change = graph.grid.camera.fx / slam.sequence.camera.fx
    if graph.focal_is_free and not is_broken and max(change, 1 / change) > LARGEST_CHANGE:
        view = 2 * math.degrees(math.atan(0.5 * graph.grid.camera.width / graph.grid.camera.fx))
        yield (
            f"the focal length was found to be {change:.1f} times the first one, a view of "
            f"{view:.0f} degrees: unless the lens has it, path and depth are wrong; give --fx"
        )
    if lens is not None and lens.is_bent and not slam.tracker.watch.breaks:
        yield (
            f"the flow fits a lens that bends straight lines, the corners by {lens.bend:+.0%}, "
            f"with {lens.saved:.0%} less cost: focal length, trajectory and map may be bent; film "
            "in the linear mode of the camera, or give --fx, --k1 and --k2"
        )
    elif other:
        times = f"{other.factor:.2f} times the present"
        found = f"the flow fits {times} focal length better, with {other.saved:.0%} less cost"
        if other.half:
            yield f"from frame {span(*other.half)} {found}: if {_ZOOMED}; run each part for itself"
        else:
            yield f"{found}: check the calibration, or give {times} --fx and --fy. If {_ZOOMED}"


def _told_by_flow(slam: Slam, fit: FocalLengthFit) -> str:
    """Say which focal length of the raw images the flow fits, of a half or of the whole run."""
    where = f"from frame {span(*fit.half)} " if fit.half else ""
    raw = slam.sequence.preparation["raw_camera"]["fx"] / slam.sequence.camera.fx  # px per px
    found = raw * fit.present * (fit.factor or 1.0)
    return f", but {where}the flow fits --fx {found:.0f} best, with {fit.saved:.0%} less cost"


def _parallax_warnings(slam: Slam) -> Iterator[str]:
    watch, graph, keyframes = slam.tracker.watch, slam.tracker.graph, slam.tracker.keyframes
    diagnostics = watch.diagnostics
    without = sum(keyframe.parallax < graph.least_parallax for keyframe in diagnostics)
    if without and 2 * without >= len(diagnostics):
        yield (
            f"{without} of {len(diagnostics)} keyframes show hardly any parallax: the camera "
            "turned or stood still, so the distances it moved are not determined (if it moved, "
            "crop what is fixed to it, such as a bonnet or a windscreen)"
            + ("" if slam.tracker.knows_depth else ", and all that the map shows is at one depth")
        )
    elif watch.hardly_walked and not keyframes.has_prior:
        yield (
            "the camera hardly did more than turn: walking moved the image by only "
            f"{watch.beyond_turns:.2f} px between neighbouring keyframes (median, for 320x240). "
            "Depth is hardly determined, and near and far may be exchanged; film while you walk "
            "sideways, crop what is fixed to the camera, and look at the pictures of the depth"
        )
    elif watch.has_two_depths:
        yield (
            f"depths by earlier and by later keyframes differ by {watch.depth_difference:.0%} "
            "(median): what moves the image is not only a camera that walks through a scene that "
            "stands still (a stabilised film, water, a zoom?). Near and far may be in disorder; "
            "look at the pictures of the depth"
        )


def _prior_warnings(slam: Slam, depth: str) -> Iterator[str]:
    keyframes = slam.tracker.keyframes
    if keyframes.overlay is not None:
        yield (
            f"{float((keyframes.overlay == 0).float().mean()):.0%} of the image stand still while "
            "the rest moves (a logo, a dashboard, bars?): tracking leaves them out, the map only "
            "as far as beta does, with all that looks like them; crop the images"
        )
    known = (keyframes.prior_disparities > 0).any(1).tolist() if depth != "none" else []
    if not all(known):
        yield (
            f"--depth {depth} knows nothing of {known.count(False)} of {len(known)} keyframes, "
            f"such as frame {keyframes.frames[known.index(False)].frame_index}: there depth is "
            "that of the motion alone; give it for all frames"
        )
    if not keyframes.has_prior and slam.tracker.knows_depth:
        yield "without a depth prior the unit of length is arbitrary"


def has_large_holes(slam: Slam) -> bool:
    """Tell whether the map shows too little for its poses and depths to be right."""
    shown = shown_static(slam)
    return shown is not None and shown < LEAST_SHOWN


def leaves_nearly_all_out(slam: Slam) -> bool:
    """Tell whether the map holds too little of the images; given masks may be as large."""
    return slam.config.uncertainty.is_learned and (left_out(slam) or 0.0) > NEARLY_ALL
