"""The sub-command `minislam export`: a finished run for COLMAP, nerfstudio and other programs."""

import argparse
from functools import partial
from os.path import expanduser
from pathlib import Path

from minislam.data.files import atomic_write, require_free, require_new
from minislam.data.run_folder import MAP, MAP_SH
from minislam.errors import require
from minislam.runs.progress import ProgressLine, quoted, say

EPILOG = """\
The world has the axes of the first camera, so y points down; the unit of length is printed.
Images and masks have the size of the source; masks are 255 where static, 0 where it moves.
Beside poses, both are as a global shutter would have seen them; --masks alone fits the source.

  minislam export output/my --nerfstudio my_ns       then: ns-train splatfacto --data my_ns
  minislam export output/my --colmap my_colmap       then: any trainer that reads COLMAP folders
  minislam export output/my --depth d --keyframes    z-depth as .npy, float32, for fusion
"""


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "export",
        help="write a run for COLMAP, nerfstudio and other programs",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EPILOG,
    )
    add = parser.add_argument
    add("folder", metavar="RUN", help="folder of a finished run")
    where = partial(add, type=expanduser)
    where("--colmap", metavar="DIR", help="images, masks, COLMAP's sparse model")
    where("--nerfstudio", metavar="DIR", help="images, masks, transforms.json")
    where("--points", metavar="FILE.ply", help="the map as a plain point cloud")
    where("--depth", metavar="DIR", help="rendered z-depth, .npy at the working size")
    where("--masks", metavar="DIR", help="255 where static, 0 where it moves")
    add("--sh-degree", type=int, choices=(1, 2, 3), help="map with zeros up to this degree, in RUN")
    add("--keyframes", action="store_true", help="only keyframes, not all frames")
    add("--overwrite", action="store_true", help="replace files of these names")
    parser.set_defaults(run=_export)


def _export(args: argparse.Namespace) -> None:
    folders = [args.colmap, args.nerfstudio, args.depth, args.masks]
    flags = "--colmap, --nerfstudio, --points, --depth, --masks and --sh-degree"
    is_asked = any([*folders, args.points, args.sh_degree])
    require(is_asked, f"at least one of {flags}", "none; say what to write")
    for folder in filter(None, folders):
        require_free(folder, args.overwrite)
    padded, own = (Path(args.folder) / name for name in (MAP_SH, MAP))
    require_new([args.points, args.sh_degree and padded], args.overwrite, [own])
    import minislam
    from minislam.data.ply import encode_ply
    from minislam.runs import export

    run, progress = minislam.load(args.folder), ProgressLine()
    for warning in run.warnings_of_breaks:
        progress.warn(warning)
    wanted = run.keyframes if args.keyframes else run.poses
    frames = [frame for frame in sorted(run.poses) if frame in wanted]
    writers = [export.export_colmap, export.export_nerfstudio, export.export_depth]
    for folder, write in zip(folders, [*writers, export.export_masks], strict=True):
        if folder:
            write(run, Path(folder), progress.over(f"writing {folder}", frames, len(frames)))
            unit = "" if write is export.export_masks else f", lengths in {run.unit}"
            say(f"{folder}: {len(frames)} frames{unit}")
    if args.points:
        export.export_points(run, Path(args.points))
        say(f"{args.points}: {len(export.points_of(run)[0])} points, lengths in {run.unit}")
    if args.sh_degree:
        atomic_write(padded, encode_ply(run.gaussians, args.sh_degree))
        say(f"{padded}: the map with zeros up to degree {args.sh_degree}")
    if args.nerfstudio:
        say(f"to go on: ns-train splatfacto --data {quoted(args.nerfstudio)}")
