"""The whole system runs on the device it is given, and nowhere else without saying so.

No test needs a GPU. `tests/pretended_gpu.py` stands for one: it refuses to mix devices as CUDA
does, and its numbers are those of the CPU, so a run there gives the same bytes.
`test_slam_gpu.py` runs the same system on a real one, where there is one.
"""

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from minislam.config import SlamConfig, with_settings
from minislam.data.checkpoint import read_checkpoint, write_checkpoint
from minislam.data.options import InputOptions
from minislam.data.run_folder import RunFolder
from minislam.data.sequence import open_sequence
from minislam.priors.choice import PriorChoice
from minislam.priors.depth import NoDepth, SimulatedDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalFlow
from minislam.priors.interfaces import Priors
from minislam.priors.networks.checkpoints import Weights
from minislam.priors.networks.droid import DroidFlow
from minislam.priors.networks.vit import DinoFeatures
from minislam.runs import measures, run
from minislam.runs.facts import run_facts
from minislam.runs.pictures import write_pictures
from minislam.runs.resume import Checkpoints
from minislam.slam import Slam
from minislam.state.stateful import Tree
from minislam.stereo import second_adjustment
from minislam.tracking import pose_from_flow
from minislam.tracking.safeguards import first_camera, focal_length, relocalisation
from tests.brief import plots_left_out
from tests.checkpoint_files import calm_droid, tiny_fit3d
from tests.pretended_gpu import GPU, PACKAGE, GpuTensor, pretended_gpu

pytestmark = pytest.mark.slow

FRAMES = 9
RESUMED_AT = 7  # frames
# Every stage, as briefly as possible: the pretended GPU is ten times as slow as the CPU.
SHORT = {
    "tracking.warmup_keyframes": 3,
    "tracking.warmup_rounds": 1,
    "tracking.warmup_iterations": 1,
    "tracking.rounds": 1,
    "tracking.iterations": 1,
    "tracking.global_iterations": 1,
    "tracking.global_interval": 2,
    "tracking.loop_min_gap": 2,
    "tracking.loop_distance": 500.0,
    "tracking.final_rounds": 1,
    "tracking.pose_iterations": 1,
    "mapping.init_iterations": 3,
    "mapping.keyframe_iterations": 2,
    "mapping.refine_iterations": 3,
    "mapping.density.interval": 3,
    "mapping.density.max_gaussians": 10000,
    "mapping.pose_refinement.enabled": True,
    "mapping.pose_refinement.tolerance": 1e3,  # px: such a map would lead the poses anywhere
}
# Where tensors come back to the CPU while a run computes: OpenCV, scipy, lists of indices.
BORDERS = {
    "priors/dense_flow.py", "priors/flow.py", "priors/features.py",
    "tracking/bundle_adjustment.py", "tracking/frame_graph.py", "tracking/keyframe_graph.py",
    "tracking/pose_from_flow.py", "tracking/schur.py", "tracking/trajectory.py",
    "tracking/safeguards/exposure.py", "tracking/safeguards/motion_memory.py",
    "tracking/safeguards/pose_support.py",
    "tracking/safeguards/relocalisation.py", "tracking/safeguards/rolling_shutter.py",
    "mapping/insertion.py", "mapping/views.py", "mapping/safeguards.py",
    "stereo/second_adjustment.py",
    "stereo/dense_structure.py", "slam.py", "splatting/gaussians.py",
    "splatting/tiles.py",  # how long the lists are
}  # fmt: skip
# What stays on the CPU: random numbers, so that no draw depends on the device.
OF_THE_CPU = ("generator", "_generator")


@dataclass
class Run:
    """A finished run, what it brought back to the CPU, and its state in the middle."""

    slam: Slam
    transfers: Counter[str] = field(default_factory=Counter)

    @property
    def results(self) -> list[np.ndarray]:
        slam, poses = self.slam, self.slam.trajectory().T_world_camera
        gaussians = [t.cpu().numpy() for t in vars(slam.mapper.gaussians).values()]
        return [poses, *gaussians, slam.render(poses[0]), slam.beta_image(0)]


@pytest.fixture(scope="module", autouse=True)
def short_stages(root: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for module, name in (
            (first_camera, "ITERATIONS"), (pose_from_flow, "POSE_ITERATIONS"),
            (focal_length, "ITERATIONS"), (focal_length, "MAX_TRIES"),
        ):  # fmt: skip
            patch.setattr(module, name, 1)
        patch.setattr(second_adjustment, "COARSE_WIDTH", 24)
        yield


def new_slam(kind: str, device: str, save: Callable[[bool], None] = lambda force: None) -> Slam:
    """Return a system: with simulated depth, without any, or with networks."""
    frames = {"depth": FRAMES, "no depth": 6, "networks": 4}[kind]
    size = (64, 48) if kind != "networks" else (72, 64)
    options = InputOptions(stride=3, max_frames=frames, size=size)
    sequence = open_sequence("synth:person", options)
    sequence.refines_focal = kind == "no depth"
    config = with_settings(SlamConfig(), SHORT)
    truth = sequence.ground_truth
    depth = NoDepth() if kind == "no depth" else SimulatedDepth(truth.depth, config.seed)
    flow, features = ClassicalFlow(), ClassicalFeatures()
    if kind == "networks":
        flow, features = DroidFlow(weights("droid", device)), DinoFeatures(weights("dino", device))
    return Slam(sequence, config, Priors(flow, features, depth), None, save, device)


@cache
def weights(network: str, device: str) -> Weights:
    tensors = tiny_fit3d() if network == "dino" else calm_droid()
    named = {name.removeprefix("module."): t.to(device) for name, t in tensors.items()}
    return Weights(named, f"{network}.pth")


@cache
def on_cpu(kind: str) -> Run:
    slam = new_slam(kind, "cpu")
    slam.run()
    return Run(slam)


def state_file(root: Path) -> Path:
    return root / "state.npz"


@pytest.fixture(scope="module", params=["depth", "no depth", "networks"])
def both(request: pytest.FixtureRequest, root: Path) -> Iterator[tuple[Run, Run]]:
    """Give the same run on the CPU and on the pretended GPU."""

    def save(force: bool) -> None:
        if slam.steps.done("tracking and mapping") == RESUMED_AT and request.param == "depth":
            write_checkpoint(state_file(root), slam.saved_state())

    expected = on_cpu(request.param)
    with pretended_gpu() as transfers:
        slam = new_slam(request.param, GPU, save)
        slam.run()
        yield expected, Run(slam, transfers)


# The whole system


def test_a_run_on_the_gpu_gives_what_the_cpu_gives(both: tuple[Run, Run]):
    expected, found = (each.results for each in both)
    if isinstance(both[0].slam.tracker.graph.flow, DroidFlow):
        # There torch chooses other kernels, whose last digits differ; they change what is pruned,
        # and with it the poses that are refined by re-rendering this unfinished map (metres).
        np.testing.assert_allclose(found[0], expected[0], atol=2e-3)
    else:
        assert all(np.array_equal(*pair) for pair in zip(expected, found, strict=True))


@pytest.mark.parametrize("both", ["depth"], indirect=True)
def test_a_lost_camera_is_found_on_the_gpu(both: tuple[Run, Run], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(relocalisation, "MIN_INLIERS", 5)  # the images are tiny
    expected, found = (place_of_second_keyframe(each.slam) for each in both)
    assert found.T_camera_world.device.type == GPU and found.inliers == expected.inliers
    assert found.T_camera_world.tolist() == expected.T_camera_world.tolist()


def place_of_second_keyframe(slam: Slam) -> relocalisation.Place:
    keyframes, finder = slam.tracker.keyframes, relocalisation.Relocaliser(slam.tracker.graph)
    place = finder.find(keyframes.frames[1].image, keyframes.features[1])
    assert place is not None
    return place


@pytest.mark.parametrize("both", ["depth"], indirect=True)
def test_everything_that_a_run_writes_is_the_same(both: tuple[Run, Run], root: Path):
    expected, found = (written(each.slam, root / f"out{k}") for k, each in enumerate(both))
    assert found == expected


def written(slam: Slam, out: Path) -> dict[str, object]:
    """Write the results and pictures of a run; return the metrics, and the bytes of some files."""
    folder, choice = RunFolder.create(out, False, []), PriorChoice(depth="simulated")
    checkpoints = Checkpoints(folder, slam.sequence, slam.config, choice)
    facts = run_facts(slam, choice, checkpoints, "finished", 0)
    metrics = measures.measure(slam, 1.0, None)
    run._write_estimates(folder, slam)
    with plots_left_out():
        write_pictures(folder, slam, metrics, facts)
    del metrics["peak_memory_mb"]
    names = ("trajectory.txt", "map.ply", "camera.json", "keyframes/000000_beta.png")
    return metrics | {name: (out / name).read_bytes() for name in names}


def test_the_whole_state_of_a_run_is_on_the_gpu(both: tuple[Run, Run]):
    strays = list(cpu_tensors(both[1].slam.saved_state()))
    assert not strays


def test_tensors_come_back_to_the_cpu_only_at_the_borders_of_packages(both: tuple[Run, Run]):
    lines = both[1].transfers
    of_results = ("outside", "runs/", "data/")
    computing = {line.split(":")[0] for line in lines if not line.startswith(of_results)}
    assert computing <= BORDERS
    images = sum(count for line, count in lines.items() if "dense_flow" in line)
    assert images <= 6 * FRAMES  # tracked, as a keyframe, posed twice; how it moved: two


def test_what_a_gpu_began_goes_on_without_one(root: Path):
    expected = on_cpu("depth")
    slam = new_slam("depth", "cpu")
    state = read_checkpoint(state_file(root), "cpu")
    slam.restore_state(state, slam.frame)
    assert len(slam.tracker.tracked) == RESUMED_AT
    slam.run()
    pairs = zip(expected.results, Run(slam).results, strict=True)
    assert all(np.array_equal(*pair) for pair in pairs)


def cpu_tensors(tree: Tree, name: str = "slam") -> Iterator[str]:
    """Yield the names of the tensors in a state that are not on the pretended GPU."""
    if isinstance(tree, torch.Tensor):
        if not isinstance(tree, GpuTensor) and name.split("/")[-1] not in OF_THE_CPU:
            yield name
    items = (
        tree.items()
        if isinstance(tree, dict)
        else enumerate(tree if isinstance(tree, list) else [])
    )
    for key, item in items:
        yield from cpu_tensors(item, f"{name}/{key}")


# What no short run reaches: every line that makes a tensor names the device

FACTORIES = {
    "arange", "empty", "eye", "full", "linspace", "ones", "rand", "randint", "randn", "randperm",
    "tensor", "as_tensor", "zeros", "empty_strided",
}  # fmt: skip
FOLDERS = ("tracking", "mapping", "splatting", "uncertainty", "stereo", "geometry", "slam.py")
MODULES = [
    path
    for folder in FOLDERS
    for path in sorted([*(PACKAGE / folder).rglob("*.py"), PACKAGE / folder])
    if path.suffix == ".py"
]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_every_new_tensor_says_where_it_is(path: Path):
    for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
            is_factory = call.func.attr in FACTORIES and ast.unparse(call.func.value) == "torch"
            says = {keyword.arg for keyword in call.keywords} & {"device", "generator"}
            assert not is_factory or says, f"line {call.lineno}: {ast.unparse(call)}"


# The pretended GPU refuses what CUDA refuses


@pytest.mark.parametrize(
    "mix",
    [
        lambda here, there: here + there,
        lambda here, there: torch.stack([here, there]),
        lambda here, there: here.add_(there),
        lambda here, there: there.index_select(0, here.long()),
        lambda here, there: here[there.long()],
        lambda here, there: torch.where(here > 0, there, 0),
    ],
)
def test_two_devices_do_not_mix(mix: Callable):
    with pretended_gpu(), pytest.raises(RuntimeError, match=r"on two devices, \(3,\) on the CPU"):
        mix(torch.ones(3), torch.ones(3, device=GPU))


def test_what_cuda_allows_is_allowed_and_transfers_are_counted():
    with pretended_gpu() as transfers:
        there = torch.arange(3.0, device=GPU)
        assert (there + torch.tensor(1.0))[torch.tensor([0, 2])].tolist() == [1.0, 3.0]
        there[[0]] = 5.0
        assert there.cpu().tolist() == [5.0, 1.0, 2.0] and float(there.sum()) == 8.0
        assert transfers == {"outside": 2}
        with pytest.raises(RuntimeError, match="numpy"):
            there.numpy()
