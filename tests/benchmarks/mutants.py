"""Break the package one line at a time: does a fast test of the same package notice?

    python -m tests.benchmarks.mutants [WORD ...]

Each mutant is one replacement in one file, tried in a scratch copy of the clone, on the tests that
stand beside it. A survivor needs a test, or is an equivalent: a change that changes nothing.
With words, only mutants whose file contains one of them.
"""

import contextlib
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path

import cv2  # noqa: F401  (imported once here, not once per mutant)
import numpy  # noqa: F401
import pytest
import scipy.spatial.transform  # noqa: F401
import torch

from tests.benchmarks.mutations import MUTANTS

ROOT = Path(__file__).parents[2]
ALARM = 120  # s; a mutant that takes longer hangs, and that is noticed
# Mutants that change nothing, each with the reason.
EQUIVALENT: dict[tuple[str, str], str] = {}


def verdict(scratch: Path, name: str, tests: str, old: str, new: str) -> str:
    """Return how the tests answer a mutant: killed, survived, stale or void.

    Stale: the line is gone. Void: the tests fail without the mutant as well.
    """
    path = scratch / "minislam" / name
    whole = path.read_text(encoding="utf-8")
    if old not in whole:
        return "stale"
    if not passes(scratch, tests):
        return "void"  # they fail without the mutant as well
    path.write_text(whole.replace(old, new, 1), encoding="utf-8")
    try:
        return "survived" if passes.__wrapped__(scratch, tests) else "killed"
    finally:
        path.write_text(whole, encoding="utf-8")


@cache
def passes(scratch: Path, tests: str) -> bool:
    """Tell whether tests pass, in a process that has imported the large packages already."""
    child = os.fork()
    if child == 0:
        os._exit(_tested(scratch, tests.split()))
    return os.waitpid(child, 0)[1] == 0


def _tested(scratch: Path, tests: list[str]) -> int:
    """Run tests in this process, which is a copy; return 0 if they all pass."""
    signal.alarm(ALARM)
    torch.set_num_threads(1)
    os.chdir(scratch)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        files = [str(scratch / "tests" / name) for name in tests]
        return int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:nbmake", *files,
                                "-o", "addopts=--import-mode=importlib"]))  # fmt: skip


def main() -> None:
    """Print one line per mutant and the score."""
    words = sys.argv[1:]
    chosen = [
        (name, tests, *change)
        for (name, tests), changes in MUTANTS.items()
        for change in changes
        if not words or any(word in name for word in words)
    ]
    if not chosen:
        raise SystemExit(f"no module has {words} in its name")
    sys.dont_write_bytecode = True  # the files change faster than their times
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    score: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "clone"
        left_out = shutil.ignore_patterns(".git", "__pycache__", "notebooks", "output")
        shutil.copytree(ROOT, scratch, ignore=left_out)
        sys.path[:] = [str(scratch), *(entry for entry in sys.path if Path(entry or ".") != ROOT)]
        os.environ["PYTHONPATH"] = str(scratch)
        for name, tests, old, new in chosen:
            found = verdict(scratch, name, tests, old, new)
            if found == "survived" and (name, old) in EQUIVALENT:
                found = "equivalent"
            score[found] += 1
            print(f"{found:10s} {name}: {old} -> {new}", flush=True)
    print(", ".join(f"{count} {kind}" for kind, count in score.items()), f"of {len(chosen)}")


if __name__ == "__main__":
    main()
