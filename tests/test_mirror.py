"""`tests/` mirrors `minislam/`: tests/ROOM/test_MODULE*.py belongs to minislam/ROOM/MODULE.py."""

from pathlib import Path

import pytest

from tests.benchmarks.mutants import MUTANTS

ROOT = Path(__file__).parent.parent
TESTS = sorted((ROOT / "tests").glob("*/**/test_*.py"))
MODULES = sorted(p for p in (ROOT / "minislam").glob("*/**/*.py") if p.stem != "__init__")

# Modules that hold no logic of their own, or whose every line runs in the tests of another one.
TESTED_ELSEWHERE: dict[str, str] = {
    "splatting/constants": "splatting/test_projection.py",
    "tracking/config": "test_config.py",
    "tracking/bundle_problem": "tracking/test_bundle_adjustment.py",
    "tracking/reference": "tracking/test_bundle_adjustment.py",
    "priors/interfaces": "priors/test_flow.py",  # protocols and two records
}


def place(path: Path) -> str:
    """Return "splatting/tiles" for minislam/splatting/tiles.py."""
    return path.relative_to(ROOT / "minislam").with_suffix("").as_posix()


def modules_of(test: Path) -> list[str]:
    """Return the modules that a test file may belong to by its name, the longest name first."""
    folder = test.relative_to(ROOT / "tests").parent
    words = test.stem.removeprefix("test_").split("_")
    names = ["_".join(words[:count]) for count in range(len(words), 0, -1)]
    tops = [ROOT / "minislam", ROOT]  # data_synth stands beside the package
    return [n for n in names for top in tops if (top / folder / f"{n}.py").exists()]


@pytest.mark.parametrize("test", TESTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_test_file_is_named_after_a_module(test: Path):
    folder = test.relative_to(ROOT / "tests").parent
    is_of_the_folder = test.stem == f"test_{folder.name}"
    assert is_of_the_folder or modules_of(test), (
        f"expected {test.name} to begin with the name of a module of {folder}, found none"
    )


@pytest.mark.parametrize("module", MODULES, ids=place)
def test_every_module_has_a_test_file(module: Path):
    if place(module) in TESTED_ELSEWHERE:
        assert (ROOT / "tests" / TESTED_ELSEWHERE[place(module)]).exists()
        return
    folder = ROOT / "tests" / Path(place(module)).parent
    owners = [modules_of(test)[:1] for test in folder.glob(f"test_{module.stem}*.py")]
    assert [module.stem] in owners, f"expected tests/{place(module)} as test_{module.stem}.py"


def test_every_mutant_changes_a_line_that_is_there():
    for (name, tests), changes in MUTANTS.items():
        text = (ROOT / "minislam" / name).read_text(encoding="utf-8")
        assert [old for old, _ in changes if old not in text] == [], name
        assert all((ROOT / "tests" / test).exists() for test in tests.split()), tests
