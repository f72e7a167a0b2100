"""The sub-command `minislam weights`: list, fetch and check official checkpoint files."""

import argparse
import hashlib
from functools import partial
from pathlib import Path

from minislam.errors import MinislamError, nearest, require
from minislam.parameters import user_path
from minislam.priors.names import PublishedFile, published_files
from minislam.runs.progress import ProgressLine

CHECKPOINT_ENDINGS = (".pth", ".pt", ".ckpt", ".bin")


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("weights", help="list, fetch or check official checkpoints")
    actions = parser.add_subparsers(required=True, metavar="list | fetch | check")
    actions.add_parser("list", help="what there is").set_defaults(run=_list)
    fetch = actions.add_parser("fetch", help="fetch files of the list from their makers' sites")
    fetch.add_argument("names", nargs="+", metavar="NAME", help="as in the list")
    fetch.set_defaults(run=_fetch)
    check = actions.add_parser("check", help="which network each file of a folder belongs to")
    check.add_argument("folder", nargs="?", metavar="DIR", help="default: what was fetched")
    check.set_defaults(run=_check)


def _list(args: argparse.Namespace) -> None:
    rows = list(published_files().values())
    for row in rows:
        here = "fetched" if row.path.exists() else ""
        print(f"{row.name:28s} {row.megabytes:>7s} MB  {row.use:22s} {row.licence:32s} {here}")
    print(f"minislam weights fetch NAME... puts them in {rows[0].path.parent}")


def _fetch(args: argparse.Namespace) -> None:
    from minislam.data.download import download

    known = published_files()
    for name in args.names:
        hint = nearest(name, known, "see which there are")
        require(name in known, "names of minislam weights list", f"{name!r}; {hint}")
    rows, progress = [known[name] for name in args.names], ProgressLine()
    found = f"no home for {rows[0].path.parent}; set MINISLAM_CACHE to a writable folder"
    require(not found.startswith("no home for ~"), "a folder for what is fetched", found)

    def show(file: str, done: int, total: int) -> None:  # bytes
        progress.show(f"fetching {file} [kB]", done // 1000, total // 1000)

    for row in rows:
        print(f"{row.name}: {row.megabytes} MB, licence {row.licence}, from {row.url}", flush=True)
    for row in rows:
        if row.path.exists():
            require_published(row, row.path, "; remove it, then fetch it again")
        else:
            download(row.url, row.path, partial(require_published, row), partial(show, row.file))
        print(f"{row.path}: complete, use it with {row.use}")


def _check(args: argparse.Namespace) -> None:
    rows = {row.file: row for row in published_files().values()}
    folder = user_path(args.folder or rows["droid.pth"].path.parent)
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in CHECKPOINT_ENDINGS)
    found = f"none in {folder}; give another one, or fetch some with minislam weights fetch"
    if not folder.is_dir():
        found = f"no folder at {folder}; check the path"
    if folder.is_file():
        found = f"the file {folder}; give the folder it is in"
    require(bool(files), f"a folder with checkpoint files ({', '.join(CHECKPOINT_ENDINGS)})", found)
    for file in files:
        row, verdict = rows.get(file.name), _verdict(file)
        if row and row.sha256 and row.sha256 != _sha256(file):
            verdict += f"; NOT the published {row.name}, its sha256 is another"
        size = file.stat().st_size / 1e6  # MB
        width = max(len(file.name) for file in files)
        print(f"{file.name:{width}s}  {size:7.1f} MB  {verdict}", flush=True)


def require_published(row: PublishedFile, path: Path, advice: str = "") -> None:
    """Refuse another file than the published one; where it has no hash, one of another network."""
    wanted, found = f"sha256 {row.sha256}", f"sha256 {_sha256(path)}"
    if not row.sha256:
        wanted, found = f"complete: {row.use}", _verdict(path)
    the_file = f"the published {row.file} ({wanted}) in {path}"
    require(found.endswith(wanted), the_file, found + advice)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _verdict(file: Path) -> str:
    """Return which network a file belongs to, whether it is complete, and the flag that uses it."""
    from minislam.evaluation.lpips import recognise_heads, recognise_trunk
    from minislam.priors.networks import table
    from minislam.priors.networks.checkpoints import load_checkpoint

    title = "unreadable"
    try:
        weights = load_checkpoint(file)
        title = table.describe(weights)
        network = table.recognise(weights)
        if network is not None:
            table.build_checked(network, weights)
            return f"{title}, complete: --{network.kind} {network.name}"
        if title == table.LPIPS_HEADS:
            recognise_heads(weights.as_dict())
            return f"{title}, complete: --lpips-heads"
        if title == table.CLASSIFIER:
            recognise_trunk(weights.as_dict())
            return f"{title}, complete: --lpips-trunk"
        return f"{title}, of no use here"
    except MinislamError as error:
        return f"{title}, NOT usable: {error}"
