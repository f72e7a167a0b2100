"""Checkpoint files: a tree of plain values as named arrays and one text, in a .npz file.

Nothing in such a file is ever executed. `numpy.load` opens it, and the name of an array is its
path in the tree: "slam/tracker/graph/keyframes/disparities".
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from minislam.data.files import atomic_file, read_bytes
from minislam.errors import InputError

_TREE = "tree.json"  # the array that holds the text
_ARRAY, _TENSOR = "@array", "@tensor"  # keys in the text that refer to an array or a tensor


def write_checkpoint(path: Path | str, tree: Any) -> None:
    """Write dictionaries and lists of tensors, arrays, numbers, text and None, atomically.

    A tensor that occurs twice is stored once, and reading gives one tensor for both places.
    """
    arrays: dict[str, np.ndarray] = {}
    names: dict[int, str] = {}  # by identity of the tensor or array

    def plain(value: Any, name: str) -> Any:
        if isinstance(value, dict):
            return {key: plain(item, f"{name}/{key}") for key, item in value.items()}
        if isinstance(value, list):
            return [plain(item, f"{name}/{number}") for number, item in enumerate(value)]
        if not isinstance(value, Tensor | np.ndarray):
            return value
        known = names.setdefault(id(value), name.removeprefix("/"))
        if isinstance(value, np.ndarray):
            arrays[known] = value
            return {_ARRAY: known}
        # Along a stride of 0, of an expanded tensor, memory holds a single row.
        rows = tuple(slice(1 if stride == 0 else None) for stride in value.stride())
        arrays[known] = value.detach()[rows].cpu().numpy()
        return {_TENSOR: [known, list(value.shape), list(value.stride()), str(value.device)]}

    text = json.dumps(plain(tree, "")).encode()
    named: dict[str, Any] = {_TREE: np.frombuffer(text, np.uint8), **arrays}
    with atomic_file(path) as file:
        np.savez(file, **named)


def read_checkpoint(path: Path | str, gpu: str = "cpu") -> Any:
    """Return the tree that was written; tensors that were on a GPU go to the device `gpu`."""
    content = io.BytesIO(read_bytes(path))
    try:
        with np.load(content, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        tensors: dict[str, Tensor] = {}

        def whole(value: dict[str, Any]) -> Any:
            if _ARRAY in value:
                return arrays[value[_ARRAY]]
            if _TENSOR not in value:
                return value
            name, shape, strides, written_on = value[_TENSOR]
            if name not in tensors:
                stored = torch.from_numpy(arrays[name])
                # Strides fix the order of summation and thereby the last bits of sums.
                there = "cpu" if written_on == "cpu" else gpu
                tensor = stored.new_empty_strided(stored.shape, strides, device=there)
                tensors[name] = tensor.copy_(stored).expand(shape)
            return tensors[name]

        return json.loads(arrays.pop(_TREE).tobytes(), object_hook=whole)
    except Exception as error:  # damaged bytes fail inside zipfile and numpy in many ways
        found = "a damaged or another file; remove it, and start again with --overwrite"
        raise InputError(f"expected a checkpoint in {path}, found {found}") from error
