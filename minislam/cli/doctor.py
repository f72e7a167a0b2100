"""The sub-command `minislam doctor`: checks the installation."""

from __future__ import annotations

import argparse
import importlib
import os
import time

import minislam
from minislam.errors import MinislamError

MAX_SELF_TEST_ERROR = 0.1  # px


def add_doctor_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add `doctor` to the sub-commands of a parser."""
    parser = subparsers.add_parser("doctor", help="show what is installed and check that it works")
    parser.set_defaults(run=run_doctor)
    return parser


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
