"""The sub-command `minislam doctor`: checks the installation."""

import argparse
import importlib
import os
import shutil
import subprocess
import time

import minislam
from minislam.errors import MinislamError

MAX_SELF_TEST_ERROR = 0.1  # px


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Add `doctor` to the commands."""
    parser = commands.add_parser("doctor", help="show what is installed and check that it works")
    parser.set_defaults(run=run_doctor)


def run_doctor(args: argparse.Namespace) -> int:
    """Print versions and threads, and compare an estimated flow with the known one."""
    import platform

    import torch

    from minislam.priors.conformance import flow_error, shifted_images
    from minislam.priors.flow import ClassicalFlow

    print(f"minislam {minislam.__version__}, Python {platform.python_version()}")
    for name in ("numpy", "scipy", "torch", "cv2", "matplotlib"):
        print(f"  {name:11s} {importlib.import_module(name).__version__}")
    print(f"  processors  {os.cpu_count()}, torch uses {torch.get_num_threads()} threads")
    print(f"  CUDA        {torch.cuda.get_device_name() if torch.cuda.is_available() else 'none'}")
    for warning in [*opencv_warnings(), *gpu_warnings(torch.cuda.is_available())]:
        print(f"  WARNING: {warning}")
    start = time.perf_counter()
    flow, (first, second) = ClassicalFlow(), shifted_images()
    error = flow_error(flow.start_chain(first).advance(second)[1], flow.stride)
    seconds = time.perf_counter() - start
    print(f"  self-test   flow of a shifted image, off by {error:.3f} px, {seconds:.1f} s")
    if not error <= MAX_SELF_TEST_ERROR:
        raise MinislamError(
            f"expected the self-test to be exact to {MAX_SELF_TEST_ERROR} px, found "
            f"{error:.3f} px; reinstall opencv-python-headless"
        )
    return 0


def opencv_warnings() -> list[str]:
    """Say if several OpenCV packages are installed, which overwrite each other's files."""
    from importlib.metadata import distributions

    names = {str(found.metadata["Name"]).lower() for found in distributions()}
    found = sorted(name for name in names if name.startswith("opencv-"))
    if len(found) < 2:
        return []
    return [f"{', '.join(found)} share one folder: uninstall all, install one of them again"]


def gpu_warnings(torch_sees_one: bool) -> list[str]:
    """Say if there is an NVIDIA GPU that this torch does not see."""
    if torch_sees_one or not shutil.which("nvidia-smi"):
        return []
    listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
    gpus = [line.split(" (UUID")[0] for line in listed.stdout.splitlines() if "GPU" in line]
    if listed.returncode or not gpus:
        return []
    return [f"torch sees no {gpus[0]}: install a torch with CUDA that fits the driver"]
