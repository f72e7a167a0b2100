"""Read official checkpoint files; nothing in them is executed.

The networks of this folder are plain functions over `Weights`, a dictionary of tensors under
their official names. Sizes are read from the shapes, and each name is written where it is used.
So one run on a tiny image checks a file: a missing tensor is named, one never read is unexpected.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from minislam.errors import InputError, require

# What trainers put the weights into: an entry of the file, or the first part of every name.
_WRAPPERS = "model_state_dict state_dict model module _orig_mod teacher net model_ema".split()


class Weights:
    """The tensors of a checkpoint, or of a part of it: those whose names start with a prefix."""

    def __init__(self, tensors: dict[str, Tensor], file: str) -> None:
        self.file = file  # for messages
        self.prefix = ""
        self.precision = torch.float32  # in which the layers of large networks compute
        self._tensors = tensors
        self._used: set[str] = set()

    def __getitem__(self, name: str) -> Tensor:
        """Return one tensor by its name without the prefix."""
        full = self.prefix + name
        if full not in self._tensors:
            wanted, found = f"the tensor {full} in {self.file}", f"{len(self._tensors)} others"
            advice = "the file is not complete or belongs to another version of the network"
            raise InputError(f"expected {wanted}, found {found}; {advice}")
        self._used.add(full)
        return self._tensors[full]

    def __contains__(self, name: str) -> bool:
        return self.prefix + name in self._tensors

    def __iter__(self) -> Iterator[str]:
        """Walk through the names below the prefix, without it."""
        return (n[len(self.prefix) :] for n in self._tensors if n.startswith(self.prefix))

    def as_dict(self) -> dict[str, Tensor]:
        """Return the tensors below the prefix under their names without it."""
        return {name: self._tensors[self.prefix + name] for name in self}

    def below(self, prefix: str) -> "Weights":
        """Return the weights whose names start with `prefix`, under their names without it."""
        part = copy(self)  # of the same tensors; what it reads counts as read
        part.prefix += prefix
        return part

    def unused(self) -> list[str]:
        """Return the names of the tensors that no function has read so far."""
        return sorted(name for name in self._tensors if name not in self._used)

    @property
    def device(self) -> torch.device:
        """Return where the tensors are, and where networks built on them run."""
        return next(iter(self._tensors.values())).device

    def autocast(self) -> AbstractContextManager[Any]:
        """Return the context in which layers compute in the precision of these weights."""
        is_mixed = self.precision is not torch.float32
        return torch.autocast(self.device.type, self.precision) if is_mixed else nullcontext()

    def linear(self, name: str, x: Tensor, bias: bool = True) -> Tensor:
        """Apply a linear layer; a missing bias is noticed, because `bias` says it must be there."""
        return functional.linear(x, self[f"{name}.weight"], self[f"{name}.bias"] if bias else None)

    def conv(
        self,
        name: str,
        x: Tensor,  # (B, C, H, W)
        stride: int = 1,
        padding: int | None = None,  # None: what keeps the size of an odd kernel at stride 1
        bias: bool = True,
        channels: tuple[int, ...] = (),  # of the output, where no later layer notices another width
    ) -> Tensor:
        """Apply a convolution."""
        weight = self[f"{name}.weight"]
        if channels and len(weight) not in channels:
            known = " or ".join(map(str, channels))
            wanted = f"{known} output channels of {self.prefix}{name}.weight in {self.file}"
            found = f"{len(weight)}; it is another version of the network"
            raise InputError(f"expected {wanted}, found {found}")
        padding = weight.shape[-1] // 2 if padding is None else padding
        return functional.conv2d(x, weight, self[f"{name}.bias"] if bias else None, stride, padding)

    def convs(self, x: Tensor, layers: int = 2, channels: tuple[int, ...] = ()) -> Tensor:
        """Apply the convolutions "0", "2", "4", ... of this part, with ReLUs between them."""
        for k in range(layers - 1):
            x = self.conv(f"{2 * k}", x).relu()
        return self.conv(f"{2 * layers - 2}", x, channels=channels)

    def residual_unit(self, x: Tensor) -> Tensor:
        """Return x + conv2(relu(conv1(relu(x)))), the residual unit of a map."""
        return x + self.conv("conv2", self.conv("conv1", x.relu()).relu())

    def upconv(self, name: str, x: Tensor) -> Tensor:
        """Apply a transposed convolution whose stride is its kernel's size."""
        weight = self[f"{name}.weight"]
        return functional.conv_transpose2d(x, weight, self[f"{name}.bias"], weight.shape[-1])

    def layer_norm(self, name: str, x: Tensor, epsilon: float) -> Tensor:
        """Normalise over the last dimension."""
        weight, bias = self[f"{name}.weight"], self[f"{name}.bias"]
        return functional.layer_norm(x, weight.shape, weight, bias, epsilon)

    def gru(
        self,
        hidden: Tensor,  # (B, C, h, w)
        inputs: Tensor,  # (B, C', h, w)
        offsets: Sequence[Tensor],  # three, added to the gates z and r and to the proposal q
    ) -> Tensor:
        """Blend the hidden state with a proposal, by a gate per channel (gated recurrent unit)."""
        both = torch.cat([hidden, inputs], 1)
        z = torch.sigmoid(self.conv("convz", both) + offsets[0])
        r = torch.sigmoid(self.conv("convr", both) + offsets[1])
        q = torch.tanh(self.conv("convq", torch.cat([r * hidden, inputs], 1)) + offsets[2])
        return (1 - z) * hidden + z * q


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    """Return maps (B, C, h, w) of another size; the centres of the corner cells stay."""
    return functional.interpolate(x, tuple(size), mode="bilinear", align_corners=True)


def load_checkpoint(path: Path | str, device: torch.device | str = "cpu") -> Weights:
    """Read a checkpoint file of plain tensors to a device; nothing in it is executed."""
    require(Path(path).is_file(), "a checkpoint file", f"nothing at {path}; check the path")
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        tensors = _tensors_in(content)
    except Exception as error:  # a broken file can break the reader anywhere
        refused = re.search(r"GLOBAL (\S+)", str(error))
        problem = f"which cannot be read as one ({type(error).__name__}); download it again"
        if refused:
            problem = (
                f"which holds a {refused[1]}, and such a Python object can run code; it is read "
                "with weights_only=True: if you trust its maker, save its tensors alone to a file"
            )
        found = f"{path} ({Path(path).stat().st_size} bytes), {problem}"
        wanted = "a PyTorch checkpoint of plain tensors"
        raise InputError(f"expected {wanted}, found {found}") from error
    found = f"the entries {list(content)}" if isinstance(content, dict) else str(type(content))
    advice = "give the file with the weights, or save the dictionary of its tensors alone to a file"
    require(bool(tensors), f"named tensors in {path}", f"{found[:300]}; {advice}")
    _require_numbers(tensors, path)
    return Weights({name: tensor.float() for name, tensor in tensors.items()}, str(path))


def _tensors_in(content: Any) -> dict[str, Tensor]:
    """Return the tensors inside all wrappers, in any order; entries beside them are dropped."""
    entries = {str(k): v for k, v in content.items()} if isinstance(content, dict) else {}
    for wrapper in _WRAPPERS:
        start = f"{wrapper}."
        inside = {n[len(start) :]: v for n, v in entries.items() if n.startswith(start)}
        if isinstance(entries.get(wrapper), dict):
            inside |= entries[wrapper]
        if inside:
            return _tensors_in(inside)
    return {name: value for name, value in entries.items() if isinstance(value, Tensor)}


def _require_numbers(tensors: dict[str, Tensor], path: Path | str) -> None:
    """Refuse tensors that are no trained weights: integers, NaN and infinity, mostly zeros."""
    found = ""
    for name, tensor in tensors.items():
        if tensor.ndim and not tensor.is_floating_point():
            found = f"{tensor.dtype} in {name}, a quantised copy"
        elif not tensor.isfinite().all():
            found = f"NaN or infinity in {name}"
    zeros = sum(not tensor.any() for tensor in tensors.values())
    if 2 * zeros > len(tensors):
        found = f"{zeros} of {len(tensors)} tensors that are zero everywhere"
    require(not found, f"finite trained weights in {path}", f"{found}; give the official file")
