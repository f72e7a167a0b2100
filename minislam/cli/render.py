"""`minislam render RUN`: the static map of a finished run as a video or an animated picture."""

import argparse
from os.path import expanduser

from minislam.cli.options import size_of
from minislam.data.files import require_new
from minislam.runs.progress import ProgressLine, say

LONGEST_SIDE = 16383  # px, of VP8 and WebP


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "render",
        help="film the static map of a finished run",
        description="Film the static map of a finished run, as .webm (video) or .webp (picture).",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("folder", metavar="RUN", help="run folder")
    add("-o", "--output", required=True, type=expanduser, help="file to write: .webm or .webp")
    add(
        "--path",
        choices=("trajectory", "orbit", "side-by-side"),
        default="trajectory",
        help="along the camera's trajectory, in a circle around the middle keyframe, or along the "
        "trajectory beside input and uncertainty; default trajectory",
    )
    add("--overwrite", action="store_true", help="replace a file of this name")
    add("--size", type=size_of, metavar="WIDTHxHEIGHT", help="of the images, default as in the run")
    parser.set_defaults(run=_render)


def _render(args: argparse.Namespace) -> None:
    from minislam.data.images import write_animation
    from minislam.data.options import MINIMUM_SIDE
    from minislam.parameters import require_bounds
    from minislam.runs import flythrough
    from minislam.runs.loaded import Run

    run = Run(args.folder)
    panels = len(flythrough.LABELS) if args.path == "side-by-side" else 1
    require_bounds("--size", args.size, MINIMUM_SIDE, LONGEST_SIDE // panels)
    inputs = [run.folder.read_config()["sequence"]] if args.overwrite else []  # a video, or none
    require_new([args.output], args.overwrite, inputs)
    camera = run.camera.resized(*args.size) if args.size else run.camera
    rate, count, progress = flythrough.frame_rate(run), len(run.poses), ProgressLine()
    for warning in run.warnings_of_breaks:
        progress.warn(warning)
    if args.path == "orbit":
        images = flythrough.fly_around(run, camera)
        rate, count = flythrough.ORBIT_RATE, flythrough.ORBIT_IMAGES
    elif args.path == "side-by-side":
        images = flythrough.side_by_side(run, camera)
    else:
        images = (run.render(pose, camera) for pose in run.poses.values())
    write_animation(args.output, progress.over("rendering", images, count), rate)
    say(f"{count} images at {rate:.0f} per second in {args.output}")
