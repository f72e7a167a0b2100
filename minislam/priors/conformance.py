"""Whether an object is what an interface asks for, found out on small images.

`plugins.py` asks before a run begins, and `minislam.checks` gives the same checks to authors: each
returns nothing, or raises InputError with a sentence that says what is wrong.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.state.stateful import Tree, to_tree

CAMERA = Camera(100.0, 100.0, 79.5, 47.5, 160, 96)  # not square: exchanged axes are noticed
SHIFT = (-8.0, -4.0)  # px (u, v), from the first to the second of the images
_STORED = dict | list | Tensor | np.ndarray | str | int | float | None  # by a saved state


def shifted_images() -> tuple[Tensor, Tensor]:  # each (H, W, 3)
    """Return a smooth random image and the same one moved by SHIFT."""
    coarse = torch.rand(1, 3, 14, 22, generator=torch.Generator().manual_seed(0))
    smooth = functional.interpolate(coarse, scale_factor=8, mode="bicubic").clamp(0, 1)
    image = smooth[0].permute(1, 2, 0)
    first, second = image[: CAMERA.height, : CAMERA.width], image[4:, 8:]
    return first.clone(), second[: CAMERA.height, : CAMERA.width].clone()


def flow_error(
    matches: FlowMatches, stride: int, shift: tuple[float, float] = SHIFT
) -> float:  # px
    """Return how far the first flow of matches is from a shift, in the middle of the image."""
    pixels = CAMERA.pixel_grid(stride)
    found = matches.targets[0].T.reshape(pixels.shape) - pixels
    rows, cols = found.shape[0] // 4, found.shape[1] // 4
    middle = found[rows:-rows, cols:-cols].flatten(0, 1).median(0).values
    return float((middle - torch.tensor(shift)).norm())


def check_depth_prior(prior: Any, name: str = "the depth prior") -> None:
    """Refuse an object that is no `DepthPrior`."""
    depth = _same_answer(name, prior, CAMERA)
    if depth is None:
        return
    _require_tensor(name, depth, (CAMERA.height, CAMERA.width))
    if not (depth >= 0).all() or not depth.any():
        raise InputError(
            f"expected {name} to return depths > 0 and 0 where unknown, found "
            f"{float(depth.min()):g} to {float(depth.max()):g}; return z in world units"
        )


def check_feature_extractor(features: Any, name: str = "the features") -> None:
    """Refuse an object that is no `FeatureExtractor`."""
    stride, dimension = (_count(name, features, field) for field in ("stride", "dimension"))
    found = _same_answer(name, features)
    _require_tensor(name, found, (CAMERA.height // stride, CAMERA.width // stride, dimension))
    if bool((found == found[0, 0]).all()):
        raise InputError(
            f"expected {name} to tell places apart, found the same vector everywhere; return "
            "features of the image"
        )


def check_flow_estimator(flow: Any, name: str = "the flow") -> None:
    """Refuse an object that is no `FlowEstimator`; it is shown an image moved by SHIFT."""
    stride, images = _count(name, flow, "stride"), shifted_images()
    pixels = CAMERA.pixel_grid(stride).flatten(0, 1).T[None]
    edges = ([0, 1], [1, 0], pixels.repeat(2, 1, 1))
    for index, image in enumerate(images):
        _call(name, flow, "add_frame", index, image)
    state = _saved_state(name, flow)
    both = _call(name, flow, "match", *edges)
    _require_matches(f"{name}.match", both, 2, stride)
    _call(name, flow, "restore_state", state, None)
    if not torch.equal(_call(name, flow, "match", *edges).targets, both.targets):
        raise InputError(
            f"expected {name} to match as before after restore_state(saved_state()), found other "
            "targets; save all that a match changes, and draw nothing at random"
        )
    start, chain_name = _call(name, flow, "start_chain", images[0]), f"the chain of {name}"
    chain, matches = _call(chain_name, start, "advance", images[1])
    _require_matches(chain_name, matches, 1, stride)
    restored = _call(name, flow, "restore_chain", _saved_state(chain_name, chain), None)
    _call(chain_name, chain, "restart")
    first, *others = [
        _call(chain_name, c, "advance", images[0])[1].targets for c in (chain, chain, restored)
    ]
    if not all(torch.equal(first, other) for other in others):
        raise InputError(
            f"expected {chain_name} to stay as it is and to be restored by restore_chain, found "
            "another answer to the same image; let advance return a new chain"
        )
    for index in range(2):
        _call(name, flow, "remove_frame", index)


def _require_matches(name: str, matches: Any, edges: int, stride: int) -> None:
    """Refuse matches of another form, and targets that are not where the second image shows."""
    if not isinstance(matches, FlowMatches):
        raise InputError(f"expected {name} to return FlowMatches, found {type(matches).__name__}")
    cells = CAMERA.pixel_grid(stride)[..., 0].numel()
    _require_tensor(f"{name} (targets)", matches.targets, (edges, 2, cells))
    _require_tensor(f"{name} (confidences)", matches.confidences, (edges, 2, cells))
    _require_tensor(f"{name} (matched_ratios)", matches.matched_ratios, (edges,))
    for part in (matches.confidences, matches.matched_ratios):
        if part.min() < 0 or part.max() > 1:
            raise InputError(
                f"expected {name} to return confidences and ratios from 0 to 1, found "
                f"{float(part.min()):g} to {float(part.max()):g}"
            )
    error = flow_error(matches, stride)
    if not error <= stride / 2:
        u, v = SHIFT
        mistakes = {"(v, u)": (v, u), "the way back": (-u, -v), "cells": (u / stride, v / stride)}
        near = [text for text, it in mistakes.items() if flow_error(matches, stride, it) < 1]
        raise InputError(
            f"expected {name} to find an image moved by {SHIFT} px, found targets off by "
            f"{error:.1f} px{f', which fits {near[0]}' if near else ''}; return the pixel (u, v) "
            "in the target"
        )


def _same_answer(name: str, function: Any, *more: Any) -> Any:
    """Return the answer to a frame, which must be the same after another frame."""
    frames = [Frame(k, float(k), image) for k, image in enumerate(shifted_images())]
    first, _, again = (_call(name, function, "__call__", frames[k], *more) for k in (0, 1, 0))
    if not torch.equal(frames[0].image, shifted_images()[0]):
        raise InputError(f"expected {name} to leave the image as it is, found it changed; copy it")
    if isinstance(first, Tensor) and not (isinstance(again, Tensor) and torch.equal(first, again)):
        raise InputError(
            f"expected {name} to answer the same frame with the same numbers, found others the "
            "second time; switch off dropout, and seed what is random"
        )
    return first


def _call(name: str, thing: Any, method: str, *arguments: Any) -> Any:
    """Call a method of somebody else's; what it raises becomes a sentence."""
    try:
        return getattr(thing, method)(*arguments)
    except Exception as error:
        raise InputError(
            f"expected {name} to have {method} and it to work on images of {CAMERA.width}x"
            f"{CAMERA.height}, found {type(error).__name__}: {str(error).partition(chr(10))[0]}"
        ) from error


def _count(name: str, thing: Any, field: str) -> int:
    value = getattr(thing, field, None)
    if not isinstance(value, int) or value < 1:
        raise InputError(f"expected {name} to have a whole number {field} >= 1, found {value!r}")
    return value


def _require_tensor(name: str, value: Any, shape: tuple[int, ...]) -> None:
    wanted = f"{shape} torch.float32 on cpu"
    found = type(value).__name__
    if isinstance(value, Tensor):
        found = f"{tuple(value.shape)} {value.dtype} on {value.device}"
        if found == wanted:
            found += " with gradients" if value.requires_grad else ""
            found += "" if value.isfinite().all() else ", not all finite"
    if found != wanted:
        raise InputError(
            f"expected {name} to return a finite tensor {wanted} like the image, found {found}"
        )


def _saved_state(name: str, thing: Any) -> Tree:
    """Return a state, unless it holds something that no file of a run can hold."""
    state = to_tree(_call(name, thing, "saved_state"))
    parts = [state]
    for part in parts:  # grows while it is walked through
        parts += part.values() if isinstance(part, dict) else part if isinstance(part, list) else ()
        if not isinstance(part, _STORED):
            raise InputError(
                f"expected {name} to save dictionaries and lists of tensors, arrays, numbers and "
                f"text, found a {type(part).__name__}"
            )
    return state
