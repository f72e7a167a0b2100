"""`minislam render RUN`: the static map of a finished run as a video or an animated picture."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from minislam.cli.options import size_of
from minislam.cli.progress import ProgressLine, say

if TYPE_CHECKING:
    import numpy as np

TRAJECTORY, ORBIT, BESIDE = "trajectory", "orbit", "side-by-side"


def add_render_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command and its options."""
    parser = commands.add_parser(
        "render",
        help="film the static map of a finished run",
        description="Film the static map of a finished run, as .webm (video) or .webp (picture).",
        allow_abbrev=False,
    )
    parser.add_argument("folder", metavar="RUN", help="run folder")
    parser.add_argument("-o", "--output", required=True, help="file to write: .webm or .webp")
    parser.add_argument(
        "--path",
        choices=(TRAJECTORY, ORBIT, BESIDE),
        default=TRAJECTORY,
        help="along the camera's trajectory, in a circle around the middle keyframe, or along the "
        "trajectory beside input and uncertainty; default trajectory",
    )
    parser.add_argument(
        "--size", type=size_of, metavar="WIDTHxHEIGHT", help="of the images, default as in the run"
    )
    parser.set_defaults(run=_render)


def _render(args: argparse.Namespace) -> int:
    from minislam.data.images import write_animation
    from minislam.data.options import MINIMUM_SIDE
    from minislam.parameters import require_bounds
    from minislam.runs import flythrough
    from minislam.runs.loaded import Run

    run = Run(args.folder)
    require_bounds("--size", args.size, MINIMUM_SIDE, 16384)
    camera = run.camera.resized(*args.size) if args.size else run.camera
    rate, count = flythrough.frame_rate(run), len(run.poses)
    if args.path == ORBIT:
        images = flythrough.fly_around(run, camera)
        rate, count = flythrough.ORBIT_RATE, flythrough.ORBIT_IMAGES
    elif args.path == BESIDE:
        images = flythrough.side_by_side(run, camera)
    else:
        images = flythrough.fly_along(run, camera)
    write_animation(args.output, _shown(images, count), rate)
    say(f"{count} images at {rate:.0f} per second in {args.output}")
    return 0


def _shown(images: Iterable[np.ndarray], count: int) -> Iterator[np.ndarray]:
    progress = ProgressLine()
    for done, image in enumerate(images, start=1):
        progress.show("rendering", done, count)
        yield image
