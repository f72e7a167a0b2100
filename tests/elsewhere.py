"""The command line in a process that differs from this one, and that says what a run must not do.

    python -m tests.elsewhere ARGUMENTS...    with the output folder as the last one

There is no network, the global random sources are in another state, and a line on stderr names
every file outside of the output folder and of the cache that is opened to be written.
"""

import os
import socket
import sys
import tempfile
from pathlib import Path

import cv2
import torch

from minislam.cli.main import main

WROTE = "wrote outside of the output folder: "
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def watch(out: Path) -> None:
    """Print what is opened to be written, or made, elsewhere than below `out` and the cache."""
    allowed = [out.resolve(), Path(os.environ["MINISLAM_CACHE"]).resolve(), Path("/dev")]
    scratch = Path(tempfile.gettempdir()).resolve()  # unnamed files, and the fonts of matplotlib

    def notice(event: str, arguments: tuple) -> None:
        is_written = event == "open" and bool(arguments[2] & WRITES)
        if not (is_written or event in ("os.mkdir", "os.rename")) or isinstance(arguments[0], int):
            return  # a number is a file that is open already
        path = Path(os.path.realpath(os.fsdecode(arguments[0])))
        is_scratch = scratch in (path, path.parent)
        if not is_scratch and not any(path.is_relative_to(folder) for folder in allowed):
            print(f"{WROTE}{path}", file=sys.stderr, flush=True)

    sys.addaudithook(notice)


if __name__ == "__main__":
    socket.socket.connect = socket.getaddrinfo = None  # type: ignore[assignment,method-assign]
    torch.default_generator.manual_seed(7)
    cv2.setRNGSeed(7)
    watch(Path(sys.argv[-1]))
    sys.exit(main(sys.argv[1:]))
