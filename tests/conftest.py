"""Settings for every test: one thread (repeatable, not slower on a busy machine), quiet plots."""

import os
import re
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))

# Here, because the conftest.py of a folder may import torch, which reads the first of them then.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MINISLAM_WORKERS", "1")  # a helper imports torch, most tests are shorter
os.environ.setdefault("MPLCONFIGDIR", tempfile.gettempdir())


def pytest_configure(config) -> None:
    """Set what the test process and the notebook kernels inherit."""
    # Notebook kernels start in notebooks/, so a bare clone needs an absolute path to the package.
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    sys.path.insert(0, str(ROOT))
    from minislam.checks.points import EXERCISES

    for exercise in EXERCISES:  # pytest -m ex03_2, pytest -m nb03
        config.addinivalue_line("markers", f"{exercise.key}: tests of {exercise.check}")
    notebooks = [path.stem for path in NOTEBOOKS] + [e.notebook for e in EXERCISES]
    for number in sorted({stem.split("_")[0] for stem in notebooks}):
        config.addinivalue_line("markers", f"nb{number}: this notebook and its exercises")
    # A job in the background (`nohup`, `&`) ignores what ends a program; its tests must not.
    for name, handler in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
        number = getattr(signal, name, None)  # no SIGHUP on Windows
        if number is not None and signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)
    from tests.beside import HalfBeside, is_whole

    if is_whole(config):
        config.pluginmanager.register(HalfBeside(config))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what is neither slow nor a notebook, and what belongs to one.

    `pytest -m fast`; `pytest -m nb03`: the notebook, its checks and the tests of its file.
    """
    for item in items:
        for number in notebooks_of(item):
            item.add_marker(f"nb{number}")
        if item.path.suffix == ".py" and item.get_closest_marker("slow") is None:
            item.add_marker(pytest.mark.fast)


def notebooks_of(item: pytest.Item) -> set[str]:
    """Return "03" for what runs notebook 03, or is marked with one of its exercises."""
    marks = {mark.name for mark in item.iter_markers()}
    numbers = {mark[2:].split("_")[0] for mark in marks if re.fullmatch(r"ex\d\db?_\d", mark)}
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    for path in (item.path, parameters.get("path")):
        if isinstance(path, Path) and path.suffix == ".ipynb":
            numbers.add(path.stem.split("_")[0])
    return numbers


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return where the runs go; the frames are rendered once, into a cache beside them."""
    from tests.brief import frames_rendered_once  # only here: it needs torch

    root = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch, frames_rendered_once():
        patch.setenv("MINISLAM_CACHE", str(root / "cache"))
        yield root
