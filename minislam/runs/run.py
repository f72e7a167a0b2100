"""One run from a name to a folder: read the sequence, do SLAM, measure it, write everything."""

import errno
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from operator import itemgetter
from pathlib import Path

import torch

from minislam.config import SlamConfig
from minislam.data import run_folder as names
from minislam.data.files import Json, atomic_write, write_json
from minislam.data.ply import GaussianArrays, encode_ply
from minislam.data.run_folder import RunFolder
from minislam.data.trajectory import write_trajectory
from minislam.errors import FAILED_EXIT, INTERRUPTED_EXIT, LOST_EXIT, require
from minislam.evaluation.lpips import Lpips
from minislam.priors.choice import PriorChoice, choose_depth, choose_features, choose_flow
from minislam.priors.interfaces import Priors
from minislam.priors.names import FILES
from minislam.records import Sequence, required_mask
from minislam.runs.facts import run_facts
from minislam.runs.flythrough import write_clip
from minislam.runs.loaded import scene_of
from minislam.runs.measures import measure
from minislam.runs.pictures import Preview, write_pictures, write_preview
from minislam.runs.resume import Checkpoints, way_on
from minislam.runs.warnings import alarms, has_large_holes, leaves_nearly_all_out
from minislam.slam import Slam
from minislam.state.steps import Observer
from minislam.tracking.safeguards.lens import BentLens
from minislam.workers import Workers, idle_cores

IMAGES_PER_FRAME = 0.4  # of the map: every fifth frame is a keyframe, and one more of every gap
REFERENCE_PIXELS = 320 * 240  # of the images of the plan's figures


def choose_priors(choice: PriorChoice, sequence: Sequence, config: SlamConfig) -> Priors:
    """Return the priors that are named, their files read and checked."""
    networks, factor = config.networks, config.uncertainty.grid_factor
    wanted = f"uncertainty.grid_factor 1 with --features {FILES}FOLDER"
    advice = "a finer grid needs the network: give the factor to minislam priors"
    require(not choice.features.startswith(FILES) or factor == 1, wanted, f"{factor}; {advice}")
    return Priors(
        choose_flow(choice, networks),
        choose_features(choice, sequence.camera, networks, sequence),
        choose_depth(choice, sequence, config.seed, networks),
    )


def _require_masks(sequence: Sequence, config: SlamConfig) -> None:
    """Read every mask once, so that a wrong one is refused before the run."""
    is_used = config.uncertainty.enabled or sequence.opened_as["input"]["masks"] is None
    require(is_used, "either --masks or --no-uncertainty", "both; leave one out")
    for index in range(len(sequence)):
        if config.uncertainty.takes_masks:
            required_mask(sequence, index)
        else:
            sequence.given_mask(index)


def plan_of(config: SlamConfig, choice: PriorChoice, sequence: Sequence) -> list[dict[str, float]]:
    """Return the stages of a run: what each shows, and about its seconds on one idle core.

    The figures come from runs of the demo, synth:crowd:61 and synth:table2:61, where about every
    fifth frame was a keyframe; without a prior, and to seek the focal length, from six real clips.
    What the results take at the end is never shown, hence "".
    """
    mapping, has_prior, frames = config.mapping, choice.depth != "none", len(sequence)
    seeks_focal = sequence.refines_focal
    scale = sequence.camera.width * sequence.camera.height / REFERENCE_PIXELS
    per_frame, iteration = frames * scale, 0.24 * mapping.image_scale * scale
    online_iterations = mapping.keyframe_iterations * config.tracking.warmup_keyframes
    first_online = iteration * min(mapping.init_iterations, online_iterations)
    late_keyframes = max(0.0, 0.2 * frames - config.tracking.warmup_keyframes)
    online = late_keyframes * mapping.keyframe_iterations * iteration if has_prior else 0.0
    coarse = {"posing frames": 0.04 * per_frame, "coarse depth": 0.03 * per_frame}
    stages = [
        {"tracking and mapping": (0.25 if has_prior else 0.5) * per_frame + online}
        | {"initialisation": (35 if seeks_focal else 5) * scale}
        | ({"first map": first_online} if has_prior else {}),
        {"final adjustment": (0.35 if seeks_focal else 0.05) * per_frame},
        coarse | {"second adjustment": 0.06 * per_frame} if config.uncertainty.enabled else {},
        {"posing all frames": 0.12 * per_frame},
        {"dense depth": 0.25 * per_frame, "first map": iteration * mapping.init_iterations},
        {"refining the map": iteration * mapping.refinement(IMAGES_PER_FRAME * frames)},
        {"refining the poses": 0.3 * per_frame} if mapping.pose_refinement.enabled else {},
    ]
    stages[-1 if stages[-1] else -2][""] = 0.1 * per_frame
    return [stage for stage in stages if stage]


def default_output(sequence: Sequence) -> str:
    """Return a run folder for a run that is given without one."""
    return f"output/{sequence.name}_{time.strftime('%Y%m%d-%H%M%S')}"


def run_in_folder(
    sequence: Sequence,
    config: SlamConfig,
    choice: PriorChoice,
    output: Path | str,
    observer: Observer,
    lpips: Lpips | None = None,
    overwrite: bool = False,  # replace an earlier run
    resume: bool = False,  # go on with an interrupted one
    workers: int | None = None,  # processes; as many as there are idle cores, at most 4
    bent: BentLens | None = None,  # with which the run has begun anew
) -> tuple[Json, Json]:
    """Check everything that may be wrong, then run SLAM into a folder; return metrics and run.json.

    Nothing of an earlier run is removed before the checks. The threads of torch are afterwards as
    they were. If an unknown lens turns out to bend straight lines, the run begins anew with it.
    """
    choice = choice.from_anywhere()
    if choice.features.startswith(FILES) or choice.depth.startswith(FILES):
        sequence.seeks_lens = False  # the files belong to the images as they are
    _require_masks(sequence, config)
    priors = choose_priors(choice, sequence, config)
    count = 1 if choice.device != "cpu" else idle_cores() if workers is None else workers
    threads = torch.get_num_threads()
    try:
        with names.locked(output), Workers(count, config.threads, observer.warn) as helpers:
            new = output, overwrite, sequence.files, bent is not None
            folder = RunFolder(output) if resume else RunFolder.create(*new)
            torch.set_num_threads(config.threads)
            checkpoints = Checkpoints(folder, sequence, config, choice)
            preview, said = Preview(folder), set[str]()

            def between_steps(force: bool) -> None:
                checkpoints.save(slam, force)
                for text in (*alarms(slam), checkpoints.problem):
                    if text is not None and text not in said:
                        observer.warn(text)
                        said.add(text)
                preview.update(slam, facts_of)

            slam = Slam(sequence, config, priors, observer, between_steps, choice.device, helpers)
            if bent:
                slam.undone_lens = bent.lens
                checkpoints.start -= bent.seconds
                slam.steps.seconds["before the lens was known"] = bent.seconds
            facts_of = partial(run_facts, slam, choice, checkpoints)
            if resume:
                checkpoints.restore(slam)
            settings = {**sequence.opened_as, "priors": asdict(choice), **asdict(config)}
            write_json(folder.path / names.CONFIG, settings)
            write_json(folder.path / names.RUN, facts_of("running", None))
            return _run(slam, folder, facts_of, lpips)
    except BentLens as found:
        observer.warn(str(found))
        straight = sequence.through_lens(found.lens.focal, *found.lens.radial)
        anew = straight, config, choice, output, observer
        return run_in_folder(*anew, lpips, overwrite=True, workers=workers, bent=found)
    finally:
        torch.set_num_threads(threads)


def _run(
    slam: Slam,
    folder: RunFolder,
    facts_of: Callable[[str, int | None], Json],  # run.json by state and exit code
    lpips: Lpips | None,
) -> tuple[Json, Json]:
    """Run SLAM, or what is left, and write the folder however it ends; return metrics, run.json."""
    interrupted = False
    try:
        try:
            slam.run()
        except KeyboardInterrupt:
            if not slam.mapper.images:  # there is no map to write yet
                raise
            interrupted = True
        facts = facts_of(*_ending(slam, interrupted))
        _write_estimates(folder, slam)
        metrics = measure(slam, facts["seconds"]["total"], lpips)
        write_json(folder.path / names.METRICS, metrics)
        clip_is_written = slam.workers.start(write_clip, str(folder.path))
        write_pictures(folder, slam, metrics, facts)
        clip_is_written()
        write_json(folder.path / names.RUN, facts)
    except BentLens as bent:
        bent.seconds = facts_of("running", None)["seconds"]["total"]
        raise
    except (Exception, KeyboardInterrupt) as error:
        if way := way_on(path := folder.path):
            if isinstance(error, KeyboardInterrupt):
                error.args = (f"interrupted; {way}",)
            elif getattr(error.__cause__, "errno", None) in (errno.ENOSPC, errno.EDQUOT):
                error.args = (f"expected space in {path}, found none; free space, then {way}",)
        ending = f"failed: {str(error) or repr(error)}", FAILED_EXIT
        if isinstance(error, KeyboardInterrupt):
            ending = "interrupted", INTERRUPTED_EXIT
        with suppress(Exception):  # a full disk: the first error is the one to hear of
            facts = facts_of(*ending)
            write_json(folder.path / names.RUN, facts)
            _write_trajectories(folder, slam)
            write_preview(folder, slam, facts)
        raise
    if not interrupted:
        folder.remove_checkpoint()
    return metrics, facts


def _ending(slam: Slam, interrupted: bool) -> tuple[str, int]:
    """Return the state of run.json and the exit code."""
    if interrupted:
        return "interrupted", INTERRUPTED_EXIT
    graph = slam.tracker.graph
    flaws = {  # the first that is true is told
        "most bundle adjustments failed": 2 * graph.failed_adjustments > graph.adjustments,
        "broken": slam.tracker.watch.breaks,
        "map with large holes": has_large_holes(slam) or leaves_nearly_all_out(slam),
        "partly lost": slam.lost_frames(),
        "images left out": slam.sequence.unread,
    }
    flaw = next((words for words, is_so in flaws.items() if is_so), None)
    return (f"finished, {flaw}", LOST_EXIT) if flaw else ("finished", 0)


def _write_trajectories(folder: RunFolder, slam: Slam) -> None:
    """Write the poses, as far as there are any; a run that ends without a map keeps them."""
    if slam.tracker.initialised:
        write_trajectory(folder.path / names.TRAJECTORY, slam.trajectory())
        write_trajectory(folder.path / names.KEYFRAME_TRAJECTORY, slam.keyframe_trajectory())
        unread = [(-1, stamp, reason) for stamp, reason in slam.sequence.unread]
        folder.write_lost_frames(sorted([*slam.lost_frames(), *unread], key=itemgetter(1)))


def _write_estimates(folder: RunFolder, slam: Slam) -> None:
    _write_trajectories(folder, slam)
    parameters = slam.mapper.gaussians.parameters.items()
    arrays = GaussianArrays(**{name: values.cpu().numpy() for name, values in parameters})
    atomic_write(folder.path / names.MAP, encode_ply(arrays))
    folder.write_mlp(slam.mapper.mlp.state_dict())
    write_json(folder.path / names.CAMERA, scene_of(slam))
