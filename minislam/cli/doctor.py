"""The sub-command `minislam doctor`: checks the installation."""

import argparse
import importlib
import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator
from importlib.util import find_spec

import minislam
from minislam.errors import require

MAX_SELF_TEST_ERROR = 0.1  # px


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser("doctor", help="show what is installed and check that it works")
    parser.set_defaults(run=_doctor)


def _doctor(args: argparse.Namespace) -> None:
    """Print versions and threads, and compare an estimated flow with the known one."""
    print(f"minislam {minislam.__version__}, Python {platform.python_version()}")
    names = ("numpy", "scipy", "torch", "cv2", "matplotlib")
    if missing := [name for name in names if find_spec(name) is None]:
        raise ModuleNotFoundError(name=", ".join(missing))  # `main` makes a sentence of it
    for name in names:
        print(f"  {name:11s} {importlib.import_module(name).__version__}")

    import torch

    from minislam.priors.conformance import flow_error, shifted_images
    from minislam.priors.flow import ClassicalFlow

    print(f"  processors  {os.cpu_count()}, torch uses {torch.get_num_threads()} threads")
    print(f"  CUDA        {torch.cuda.get_device_name() if torch.cuda.is_available() else 'none'}")
    for warning in installation_warnings(torch.cuda.is_available()):
        print(f"  WARNING: {warning}")
    start = time.perf_counter()
    flow, (first, second) = ClassicalFlow(), shifted_images()
    error = flow_error(flow.start_chain(first).advance(second)[1], flow.stride)
    seconds = time.perf_counter() - start
    print(f"  self-test   flow of a shifted image, off by {error:.3f} px, {seconds:.1f} s")
    found = f"{error:.3f} px; reinstall opencv-python-headless"
    wanted = f"the self-test to be exact to {MAX_SELF_TEST_ERROR} px"
    require(error <= MAX_SELF_TEST_ERROR, wanted, found)


def installation_warnings(torch_sees_a_gpu: bool) -> Iterator[str]:
    """Say if packages of OpenCV overwrite each other's files, and if torch misses a GPU."""
    from importlib.metadata import distributions

    names = {str(found.metadata["Name"]).lower() for found in distributions()}
    packages = sorted(name for name in names if name.startswith("opencv-"))
    if len(packages) > 1:
        yield f"{', '.join(packages)} share one folder: uninstall all, install one of them again"
    if not torch_sees_a_gpu and shutil.which("nvidia-smi"):
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
        gpus = [line.split(" (UUID")[0] for line in listed.stdout.splitlines() if "GPU" in line]
        if gpus and not listed.returncode:
            yield f"torch sees no {gpus[0]}: install a torch with CUDA that fits the driver"
