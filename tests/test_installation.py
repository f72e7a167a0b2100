"""What is installed where: ranges that agree, complete archives, systems without POSIX modules."""

import fnmatch
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
REQUIRED = PROJECT["project"]["dependencies"]
ENVIRONMENT = (ROOT / "environment.txt").read_text(encoding="utf-8").splitlines()
# Where a module is None in sys.modules, its import fails as on Windows.
WITHOUT_POSIX = """
import sys
sys.modules["resource"] = sys.modules["fcntl"] = None
from minislam.cli.main import main
from minislam.state.memory import peak_memory_mb
assert peak_memory_mb() is None
sys.exit(main(["doctor"]))
"""


def version(text: str) -> tuple[int, ...]:
    return tuple(map(int, text.split(".")))


def test_the_tested_torch_lies_in_the_range_that_is_required():
    least, below = re.fullmatch(r"torch>=([\d.]+),<([\d.]+)", REQUIRED[0]).groups()
    tested = next(line for line in ENVIRONMENT if line.startswith("torch=="))
    assert version(least) <= version(tested.removeprefix("torch==")) < version(below)
    binder = (ROOT / ".binder/requirements.txt").read_text(encoding="utf-8")
    assert f"{tested}+cpu\n" in binder


def test_the_environment_has_all_other_requirements():
    assert set(REQUIRED[1:]) | {"-e ."} <= set(ENVIRONMENT)


def test_python_is_stated_as_the_workflow_tests_it():
    oldest = PROJECT["project"]["requires-python"].removeprefix(">=")
    workflow = (ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8")
    assert f'python: ["{oldest}", ' in workflow
    for tool in ("windows-latest", "macos-latest", "python -m build"):
        assert tool in workflow


def test_the_source_archive_has_every_file_of_the_repository():
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("this copy is no repository")
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    data = PROJECT["tool"]["setuptools"]["package-data"]["minislam"]
    patterns = ["minislam/**.py", "data_synth/**.py", *(f"minislam/{name}" for name in data)]
    patterns += ["README.md", "LICENSE", "pyproject.toml", "setup.py", "MANIFEST.in"]  # always
    for line in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines():
        word, *names = line.split()
        if word == "recursive-include":
            names = [f"{names[0]}/{name}" for name in names[1:]]
        patterns += names if word != "#" else []
    missing = [
        name
        for name in listed.stdout.splitlines()
        if not any(fnmatch.fnmatch(name, pattern.replace("**/", "*")) for pattern in patterns)
    ]
    assert missing == [".gitattributes", ".gitignore"]


@pytest.mark.slow
def test_it_works_without_the_modules_that_windows_lacks():
    command = [sys.executable, "-c", WITHOUT_POSIX]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert "self-test   flow of a shifted image" in found.stdout


def test_a_build_has_the_notebooks_inside_and_links_to_the_repository(tmp_path: Path):
    pytest.importorskip("setuptools", minversion="77")
    for name in ("setup.py", "README.md", "LICENSE", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("minislam/__init__.py", "notebooks/00_start_here.ipynb"):
        (tmp_path / name).parent.mkdir()
        shutil.copy(ROOT / name, tmp_path / name)
    with open(tmp_path / "pyproject.toml", "a") as file:
        file.write('\n[project.urls]\nRepository = "https://example.org/minislam"\n')
    command = [sys.executable, "setup.py", "-q", "build_py", "--build-lib", "out", "egg_info"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert (tmp_path / "out/minislam/notebooks/00_start_here.ipynb").is_file()
    text = (tmp_path / "minislam.egg-info/PKG-INFO").read_text(encoding="utf-8")
    assert "](https://example.org/minislam/raw/main/notebooks/images/overview.png)" in text
    assert "](#reading-path)" in text and "](notebooks/" not in text
