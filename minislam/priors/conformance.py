"""Whether an object conforms to an interface, tested on two small images.

`choice.py` asks before a run begins, and `minislam.checks` gives the same checks to authors: each
returns nothing, or raises InputError with a sentence that says what is wrong.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError, require
from minislam.geometry import Camera
from minislam.priors.interfaces import FlowMatches
from minislam.records import Frame
from minislam.state.stateful import Tree, to_tree

# Not square, so that exchanged axes are noticed; RAFT needs 128 px per side.
CAMERA = Camera(150.0, 150.0, 111.5, 79.5, 224, 160)
SHIFT = (-8.0, -4.0)  # px (u, v), from the first to the second of the images
_STORED = dict | list | Tensor | np.ndarray | str | int | float | None  # in a saved state


def shifted_images() -> tuple[Tensor, Tensor]:  # each (H, W, 3)
    """Return a smooth random image and the same one moved by SHIFT."""
    coarse = torch.rand(1, 3, 22, 30, generator=torch.Generator().manual_seed(0))
    smooth = functional.interpolate(coarse, scale_factor=8, mode="bicubic").clamp(0, 1)
    image = smooth[0].permute(1, 2, 0)  # 16 px higher and wider than the camera's
    return image[:-16, :-16].clone(), image[4:-12, 8:-8].clone()


def flow_error(matches: FlowMatches, stride: int, shift: tuple[float, float] = SHIFT) -> float:
    """Return how far the first flow is from a shift in the middle of the image [px]."""
    pixels = CAMERA.pixel_grid(stride)
    found = matches.targets[0].T.reshape(pixels.shape) - pixels
    rows, cols = found.shape[0] // 4, found.shape[1] // 4
    middle = found[rows:-rows, cols:-cols].flatten(0, 1).median(0).values
    return float((middle - torch.tensor(shift)).norm())


def check_depth_prior(prior: Any, name: str = "the depth prior") -> None:
    """Refuse an object that is no `DepthPrior`."""
    depth = _same_answer(name, prior, CAMERA)
    if depth is not None:
        _expect_tensor(name, depth, (CAMERA.height, CAMERA.width))
        low, high = map(float, depth.aminmax())
        found = f"{low:g} to {high:g}; return z in world units"
        require(low >= 0 and high > 0, f"{name} to return depths > 0 and 0 where unknown", found)


def check_feature_extractor(features: Any, name: str = "the features") -> None:
    """Refuse an object that is no `FeatureExtractor`."""
    stride, dimension = (_count(name, features, field) for field in ("stride", "dimension"))
    found = _same_answer(name, features)
    _expect_tensor(name, found, (CAMERA.height // stride, CAMERA.width // stride, dimension))
    differ = bool((found != found[0, 0]).any())
    require(differ, f"{name} to tell places apart", "the same vector everywhere")


def check_flow_estimator(flow: Any, name: str = "the flow") -> None:
    """Refuse an object that is no `FlowEstimator`; it is shown an image moved by SHIFT."""
    stride, images = _count(name, flow, "stride"), shifted_images()
    learned = getattr(flow, "learned_confidence", None)
    require(isinstance(learned, bool), f"{name} to say learned_confidence: True or False", learned)
    edges = [0, 1], [1, 0], CAMERA.pixel_grid(stride).flatten(0, 1).T.repeat(2, 1, 1)
    for index, image in enumerate(images):
        _call(name, flow, "add_frame", index, image)
    state = _saved_state(name, flow)
    first = _call(name, flow, "match", *edges)
    _expect_matches(f"{name}.match", first, 2, stride)
    _call(name, flow, "restore_state", state, None)
    again = _call(name, flow, "match", *edges)
    _expect_matches(f"{name}.match after restore_state", again, 2, stride)
    wanted = f"{name} to match as before after restore_state(saved_state())"
    require(torch.equal(first.targets, again.targets), wanted, "other targets; save all it changes")
    damping = _call(name, flow, "disparity_damping", len(images))
    if damping is not None:
        _expect_tensor(f"{name} (disparity_damping)", damping, (len(images), edges[2].shape[2]))
    start, of_chain = _call(name, flow, "start_chain", images[0]), f"the chain of {name}"
    chain, matches = _advance(of_chain, start, images[1])
    _expect_matches(of_chain, matches, 1, stride)
    restored = _call(name, flow, "restore_chain", _saved_state(of_chain, chain), None)
    _call(of_chain, chain, "restart")
    answers = [_advance(of_chain, x, images[0])[1] for x in (chain, chain, restored)]
    are_equal = all(torch.equal(answer.targets, answers[0].targets) for answer in answers)
    wanted = f"{of_chain} to stay as it is, and restore_chain to return it"
    found = "another answer to the same image; let advance and restart return new chains"
    require(are_equal, wanted, found)
    for index in (0, 1):
        _call(name, flow, "remove_frame", index)


def _advance(name: str, chain: Any, image: Tensor) -> tuple[Any, FlowMatches]:
    """Return the next chain and the matches to an image."""
    answer = _call(name, chain, "advance", image)
    parts = answer if isinstance(answer, tuple) else (answer,)
    is_pair = len(parts) == 2 and isinstance(parts[1], FlowMatches)
    found = ", ".join(type(part).__name__ for part in parts)
    require(is_pair, f"advance of {name} to return a chain and FlowMatches", found)
    return answer


def _expect_tensor(name: str, value: Any, shape: tuple[int, ...]) -> None:
    wanted, found = f"{shape} torch.float32 on cpu", type(value).__name__
    if isinstance(value, Tensor):
        found = f"{tuple(value.shape)} {value.dtype} on {value.device}"
        if found == wanted and (value.requires_grad or not value.isfinite().all()):
            found += " with gradients" if value.requires_grad else ", not all finite"
    require(found == wanted, f"{name} to return a finite tensor {wanted} like the image", found)


def _expect_matches(name: str, matches: Any, edges: int, stride: int) -> None:
    """Refuse matches of another form, and targets that are not where the second image shows."""
    is_right = isinstance(matches, FlowMatches)
    require(is_right, f"{name} to return FlowMatches", type(matches).__name__)
    shape = (edges, 2, CAMERA.pixel_grid(stride)[..., 0].numel())
    _expect_tensor(f"{name} (targets)", matches.targets, shape)
    _expect_tensor(f"{name} (confidences)", matches.confidences, shape)
    _expect_tensor(f"{name} (matched_ratios)", matches.matched_ratios, shape[:1])
    for part in (matches.confidences, matches.matched_ratios):
        low, high = map(float, part.aminmax())
        require(low >= 0 and high <= 1, f"{name} to return 0 to 1", f"{low:g} to {high:g}")
    u, v = SHIFT
    mistakes = {"(v, u)": (v, u), "the way back": (-u, -v), "cells": (u / stride, v / stride)}
    near = [text for text, it in mistakes.items() if flow_error(matches, stride, it) < 1]
    error, hint = flow_error(matches, stride), f" which fits {near[0]}," if near else ""
    found = f"targets off by {error:.1f} px,{hint} return the pixel (u, v) in the target"
    require(error <= stride / 2, f"{name} to find an image moved by {SHIFT} px", found)


def _same_answer(name: str, function: Any, *more: Any) -> Any:
    """Return the answer to a frame, which must be the same after another frame."""
    frames = [Frame(k, float(k), image) for k, image in enumerate(shifted_images())]
    first, _, again = (_call(name, function, "__call__", frames[k], *more) for k in (0, 1, 0))
    is_kept = torch.equal(frames[0].image, shifted_images()[0])
    require(is_kept, f"{name} to leave the image as it is", "it changed; copy it first")
    is_same = type(first) is type(again)
    if is_same and isinstance(first, Tensor):
        # NaN equals nothing; who asks for a finite tensor refuses it.
        is_same = torch.equal(first, again) or not bool(first.isfinite().all())
    hint = "others the second time; switch off dropout, and seed what is random"
    require(is_same, f"{name} to answer the same frame with the same numbers", hint)
    return first


def _call(name: str, thing: Any, method: str, *arguments: Any) -> Any:
    """Call a method of somebody else's; what it raises becomes a sentence."""
    try:
        return getattr(thing, method)(*arguments)
    except Exception as error:
        found = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        size = f"{CAMERA.width}x{CAMERA.height}"
        raise InputError(f"expected {method} of {name} on {size} px, found {found}") from error


def _count(name: str, thing: Any, field: str) -> int:
    value = getattr(thing, field, None)
    is_count = isinstance(value, int) and value >= 1
    require(is_count, f"{name} to have a whole number {field} >= 1", repr(value))
    return int(value or 0)


def _saved_state(name: str, thing: Any) -> Tree:
    """Return a state, unless it holds something that no file of a run can hold."""
    state = to_tree(_call(name, thing, "saved_state"))
    wanted = f"{name} to save dictionaries and lists of tensors, arrays, numbers and text"
    nodes = [state]
    for node in nodes:  # grows while it is walked through
        nodes += node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
        require(isinstance(node, _STORED), wanted, f"a {type(node).__name__}")
    return state
