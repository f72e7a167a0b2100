"""The sub-command `minislam doctor`: checks the installation, and recognises checkpoint files."""

from __future__ import annotations

import argparse
import importlib
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING

import minislam
from minislam.errors import InputError, MinislamError

if TYPE_CHECKING:
    from minislam.priors.networks.checkpoints import Weights

MAX_SELF_TEST_ERROR = 0.1  # px
CHECKPOINT_ENDINGS = (".pth", ".pt", ".ckpt", ".bin")
BYTES_PER_MEGABYTE = 1e6


def add_doctor_parser(subparsers: argparse._SubParsersAction) -> argparse.ArgumentParser:
    """Add `doctor` to the sub-commands of a parser."""
    parser = subparsers.add_parser("doctor", help="show what is installed and check that it works")
    parser.add_argument(
        "--weights", metavar="DIR", help="recognise the checkpoint files in a folder instead"
    )
    parser.set_defaults(run=run_doctor)
    return parser


def run_doctor(args: argparse.Namespace) -> int:
    """Print what was found; return the exit code."""
    if args.weights is not None:
        return _print_checkpoints(Path(args.weights).expanduser())
    return _print_installation()


def _print_installation() -> int:
    """Print versions and threads, and compare an estimated flow with the known one."""
    import platform

    import torch

    print(f"minislam {minislam.__version__}, Python {platform.python_version()}")
    for name in ("numpy", "scipy", "torch", "cv2", "matplotlib"):
        print(f"  {name:11s} {importlib.import_module(name).__version__}")
    print(f"  processors  {os.cpu_count()}, torch uses {torch.get_num_threads()} threads")
    print(f"  CUDA        {torch.cuda.get_device_name() if torch.cuda.is_available() else 'none'}")
    start = time.perf_counter()
    error = _self_test()
    seconds = time.perf_counter() - start
    print(f"  self-test   flow of a shifted image, off by {error:.3f} px, {seconds:.1f} s")
    if not error <= MAX_SELF_TEST_ERROR:
        raise MinislamError(
            f"expected the self-test to be exact to {MAX_SELF_TEST_ERROR} px, found "
            f"{error:.3f} px; reinstall opencv-python-headless"
        )
    return 0


def _self_test() -> float:
    """Return the error of the flow between an image and the same image shifted [px]."""
    from minislam.priors.conformance import flow_error, shifted_images
    from minislam.priors.flow import ClassicalFlow

    flow, (first, second) = ClassicalFlow(), shifted_images()
    return flow_error(flow.start_chain(first).advance(second)[1], flow.stride)


def _print_checkpoints(folder: Path) -> int:
    """Print one line per checkpoint file: which network, how large, complete or not, its flag."""
    files = []
    if folder.is_dir():
        files = sorted(p for p in folder.iterdir() if p.suffix.lower() in CHECKPOINT_ENDINGS)
    if not files:
        raise InputError(
            f"expected a folder with checkpoint files ({', '.join(CHECKPOINT_ENDINGS)}), found "
            f"none in {folder}; check the path"
        )
    width = max(len(file.name) for file in files)
    for file in files:
        size = file.stat().st_size / BYTES_PER_MEGABYTE
        print(f"{file.name:{width}s}  {size:7.1f} MB  {_verdict(file)}", flush=True)
    return 0


def _verdict(file: Path) -> str:
    """Return which network a file belongs to, and whether it is complete."""
    from minislam.priors.networks.checkpoints import load_checkpoint
    from minislam.priors.networks.table import describe

    try:
        weights = load_checkpoint(file)
        title = describe(weights)
    except MinislamError as error:
        return f"unreadable: {error}"
    try:
        use = _use_of(weights, title)
    except MinislamError as error:
        return f"{title}, NOT usable: {error}"
    return f"{title}, complete: {use}" if use else f"{title}, of no use here"


def _use_of(weights: Weights, title: str) -> str:
    """Check a checkpoint; return the flags that use it, "" if nothing does."""
    from minislam.evaluation.lpips import recognise_heads, recognise_trunk
    from minislam.priors.networks.table import CLASSIFIER, LPIPS_HEADS, build_checked, recognise

    network = recognise(weights)
    if network is not None:
        build_checked(network, weights)
        return f"--{network.kind} {network.name} --{network.kind}-weights"
    if title == LPIPS_HEADS:
        recognise_heads(weights.as_dict())
        return "--lpips-heads"
    if title == CLASSIFIER:
        recognise_trunk(weights.as_dict())
        return "--lpips-trunk"
    return ""
