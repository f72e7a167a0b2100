"""The shape of the package: who may import whom, how long a module is, what is forbidden."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = sorted((ROOT / "minislam").rglob("*.py"))
SYNTHETIC = sorted((ROOT / "data_synth").rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))
LONGEST_MODULE = 300  # lines
MOST_PAIRS = 111  # of parts of which one imports the other

# A part may import what stands before it and nothing that stands after it.
FOUNDATION = ["errors", "parameters", "geometry", "images", "records", "state", "workers"]
ALGORITHMS = ["splatting", "priors", "uncertainty", "tracking", "mapping", "stereo"]
ALLOWED = {
    "errors": [],
    "parameters": ["errors"],
    "geometry": ["errors", "parameters"],
    "images": [],
    "records": ["errors", "parameters", "geometry"],
    "state": ["records"],
    "workers": ["errors", "records", "state"],
    "splatting": FOUNDATION,
    "priors": [*FOUNDATION, "splatting"],
    "uncertainty": [*FOUNDATION, "splatting", "priors"],
    "tracking": [*FOUNDATION, "splatting", "priors", "uncertainty"],
    "mapping": [*FOUNDATION, "splatting", "priors", "uncertainty"],
    "stereo": [*FOUNDATION, "priors", "tracking"],
    "config": [*FOUNDATION, *ALGORITHMS],
    "data": FOUNDATION,
    "evaluation": FOUNDATION,
    "viz": FOUNDATION,
    "checks": [*FOUNDATION, *ALGORITHMS, "evaluation"],
}
# What puts the system together.
TOP = ["slam", "runs", "cli", "__main__"]
RUN_TIME_LIBRARIES = {"numpy", "scipy", "torch", "matplotlib", "cv2"}


def part_of(path: Path) -> str:
    """Return the first level below minislam: "geometry" for minislam/geometry/se3.py."""
    return path.relative_to(ROOT / "minislam").parts[0].removesuffix(".py")


def dotted_name(path: Path) -> str:
    """Return "minislam.geometry.se3" for minislam/geometry/se3.py."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported_modules(path: Path) -> list[str]:
    """Return the dotted names of all imports of a file, also of those inside functions."""
    names = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            package = short(path).split("/")[0] + "." if node.level else ""
            module = f"{package}{node.module}"
            names += [module] + [f"{module}.{a.name}" for a in node.names]
    return names


def dotted(node: ast.expr) -> str:
    """Return "a.b.c" for the expression a.b.c, and "" for anything else."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def calls_of(path: Path) -> list[tuple[str, ast.Call]]:
    nodes = (node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call))
    return [(dotted(node.func), node) for node in nodes]


def short(path: Path) -> str:
    return str(path.relative_to(ROOT))


# Import direction


@pytest.mark.parametrize("path", PACKAGE, ids=short)
def test_imports_point_one_way(path: Path):
    part = part_of(path)
    if part == "__init__" or part in TOP:
        return
    assert part in ALLOWED, f"{short(path)} has no place in the order of imports: add it here"
    for name in imported_modules(path):
        other = name.split(".")[1] if name.startswith("minislam.") else part
        is_constant_of_the_package = other.startswith("__")  # minislam.__version__
        assert other in [part, *ALLOWED[part]] or is_constant_of_the_package, (
            f"{short(path)} imports {name}, which stands after {part}"
        )


def test_parts_know_few_others():
    parts, pairs = {part_of(path) for path in PACKAGE}, set()
    for path in PACKAGE:
        others = {name.split(".")[1] for name in imported_modules(path) if "minislam." in name}
        pairs |= {(part_of(path), other) for other in others & parts - {part_of(path)}}
    assert len(pairs) <= MOST_PAIRS


def test_no_files_import_each_other():
    paths = {dotted_name(path): path for path in PACKAGE if path.stem != "__init__"}
    imports = {name: {*imported_modules(path)} & paths.keys() for name, path in paths.items()}
    TopologicalSorter(imports).prepare()  # raises CycleError


@pytest.mark.parametrize("path", SYNTHETIC, ids=short)
def test_the_synthetic_data_imports_nothing_of_the_package(path: Path):
    # It is the oracle of the tests: a shared function would share its mistakes.
    assert not [name for name in imported_modules(path) if name.split(".")[0] == "minislam"]


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_only_the_stated_libraries_are_imported(path: Path):
    standard = __import__("sys").stdlib_module_names
    for name in imported_modules(path):
        first = name.split(".")[0]
        known = first in standard or first in RUN_TIME_LIBRARIES
        assert known or first in ("minislam", "data_synth"), f"{short(path)} imports {name}"
        if first == "data_synth" and path in PACKAGE:
            assert part_of(path) in [*TOP, "data"], f"{short(path)} imports the synthetic data"


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_only_viz_draws(path: Path):
    if path in PACKAGE and part_of(path) == "viz":
        return
    assert not [n for n in imported_modules(path) if n.split(".")[0] == "matplotlib"], short(path)


# Form

# Explained by torch, by a Protocol or base class, or for all commands in minislam/cli/__init__.py.
EXPLAINED_ONCE = {
    "forward", "backward",
    "restore_state",  # Stateful
    "source_name", "source_index", "sensor_depth",  # Sequence
    "add_frame", "remove_frame", "match", "disparity_damping", "start_chain",  # FlowEstimator
    "restore_chain", "advance", "restart",
    "add_parser",
}  # fmt: skip
RECEIVERS = {"self", "cls", "ctx"}  # their type is known from where they stand


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC + TESTS, ids=short)
def test_a_module_can_be_read_in_one_sitting(path: Path):
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LONGEST_MODULE, f"{short(path)} has {lines} lines"


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_modules_and_public_functions_have_docstrings(path: Path):
    tree = tree_of(path)
    if path.name != "__init__.py" or tree.body:
        assert ast.get_docstring(tree), f"{short(path)} has no docstring"
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_"]
    # Methods of the synthetic shapes answer to a Protocol that explains them once.
    for parent in [tree, *(classes if path in PACKAGE else [])]:
        for node in parent.body:
            is_public = isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name[0] != "_"
            if is_public and node.name not in EXPLAINED_ONCE:
                assert ast.get_docstring(node), f"{short(path)}: {node.name} has no docstring"


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_arguments_are_annotated_and_named(path: Path):
    for node in ast.walk(tree_of(path)):
        if not isinstance(node, ast.FunctionDef):
            continue
        arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        bare = [a.arg for a in arguments if a.annotation is None and a.arg not in RECEIVERS]
        assert not bare, f"{short(path)}: {node.name} has no annotation for {bare}"
        # The door for Python takes the fields of two dataclasses by name.
        is_door = short(path) == "minislam/runs/api.py"
        hidden = node.args.kwarg is not None and not node.name.startswith("_") and not is_door
        assert not hidden, f"{short(path)}: {node.name} hides its arguments behind **"


# Forbidden calls

GLOBAL_TORCH_RANDOM = {
    "rand", "randn", "randint", "randperm", "normal", "bernoulli", "multinomial",
    "manual_seed", "seed",
}  # fmt: skip
SEEDED_NUMPY_RANDOM = {"default_rng", "Generator", "SeedSequence", "PCG64"}


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC + TESTS, ids=short)
def test_no_global_random_numbers(path: Path):
    for name, call in calls_of(path):
        where = f"{short(path)}:{call.lineno}: {name}"
        keywords = {keyword.arg for keyword in call.keywords}
        if name.startswith(("np.random.", "numpy.random.")):
            assert name.rsplit(".", 1)[1] in SEEDED_NUMPY_RANDOM, where
            if name.endswith("default_rng"):
                assert call.args or call.keywords, f"{where} without a seed"
        if name.startswith("torch.") and name.split(".")[1] in GLOBAL_TORCH_RANDOM:
            assert "generator" in keywords, f"{where} without a generator"
        if name.startswith("random."):
            assert name == "random.Random" and (call.args or call.keywords), where
        assert not name.endswith("_like") or "rand" not in name, f"{where} takes no generator"


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_nothing_that_runs_foreign_code(path: Path):
    forbidden = {"pickle", "shelve", "marshal"}
    found = {name.split(".")[0] for name in imported_modules(path)} & forbidden
    assert not found, f"{short(path)} imports {found}"
    for name, call in calls_of(path):
        where = f"{short(path)}:{call.lineno}: {name}"
        assert name not in ("eval", "exec", "compile", "os.system", "torch.hub.load"), where
        arguments = {k.arg: getattr(k.value, "value", None) for k in call.keywords}
        if name == "torch.load":
            assert arguments.get("weights_only") is True, where
        if name in ("np.load", "numpy.load"):
            assert arguments.get("allow_pickle") is not True, where
        assert arguments.get("shell") is not True, where


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_numbers_are_written_alike_in_every_country(path: Path):
    # Only these two know of decimal commas; f"{x:.6f}" and str(x) do not.
    assert "locale" not in imported_modules(path), short(path)
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FormattedValue) and node.format_spec is not None:
            assert not ast.unparse(node.format_spec).endswith(("n'", 'n"')), short(path)


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_no_run_touches_the_network(path: Path):
    # One module may, and only `minislam weights fetch` imports it.
    names = imported_modules(path)
    network = {"socket", "urllib", "http", "requests"} & {name.split(".")[0] for name in names}
    assert not network or short(path) == "minislam/data/download.py", f"{short(path)}: {network}"
    downloads = any(name.startswith("minislam.data.download") for name in names)
    assert not downloads or short(path) == "minislam/cli/weights.py", short(path)


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_only_the_command_line_and_the_progress_of_a_run_print(path: Path):
    if path.stem == "cli" or (path in PACKAGE and part_of(path) in ("cli", "__main__")):
        return
    if short(path) == "minislam/runs/progress.py":
        return
    printing = [call.lineno for name, call in calls_of(path) if name == "print"]
    assert not printing, f"{short(path)} prints in lines {printing}"


@pytest.mark.parametrize("path", PACKAGE + SYNTHETIC, ids=short)
def test_no_machine_paths(path: Path):
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            assert not node.value.startswith(("/home/", "/tmp/", "/Users/", "C:\\")), short(path)
