"""A second device for machines without a GPU: computes on the CPU, refuses what CUDA refuses.

The device is called "meta", because every torch knows that name. A tensor on it holds a CPU tensor
inside and otherwise behaves like one on a GPU:

* an operation on tensors of both devices is an error, but for 0-dimensional ones of the CPU,
  for indices of the CPU, and for copies;
* `.numpy()` is an error: say `.cpu()` first.

    with pretended_gpu() as transfers:
        run(device=GPU)
    print(transfers)  # how often each line of minislam brought a tensor back to the CPU

The numbers are bit for bit those of the CPU, so results can be compared, too.
"""

import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from minislam.state import threads

GPU = "meta"
PACKAGE = Path(__file__).parent.parent / "minislam"
aten = torch.ops.aten

_COPY_TO, _COPY = aten._to_copy.default, aten.copy_.default
_INDEXING = (aten.index.Tensor, aten.index_put_.default, aten._index_put_impl_.default)


class GpuTensor(Tensor):
    """A tensor that pretends to be on the GPU."""

    inside: Tensor

    @staticmethod
    def __new__(cls, inside: Tensor) -> "GpuTensor":
        layout = inside.shape, inside.stride(), inside.storage_offset()
        return Tensor._make_wrapper_subclass(cls, *layout, dtype=inside.dtype, device=GPU)

    def __init__(self, inside: Tensor) -> None:
        self.inside = inside

    def __repr__(self) -> str:
        return f"GpuTensor({self.inside})"

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def new_tensor(self, data: Any, dtype: torch.dtype | None = None) -> Tensor:
        return torch.tensor(data, dtype=dtype or self.dtype).to(GPU)

    def __getitem__(self, place: Any) -> Tensor:
        return super().__getitem__(_place(place))

    def __setitem__(self, place: Any, value: Any) -> None:
        super().__setitem__(_place(place), value)

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


class _Calls(TorchDispatchMode):
    """Sees every operation, also those that create tensors."""

    def __init__(self, transfers: Counter[str]) -> None:
        super().__init__()
        self.transfers = transfers

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = _run(function, args, kwargs or {})
        if function in (_COPY_TO, _COPY):
            read = args[function is _COPY]
            if isinstance(read, GpuTensor) and not isinstance(result, GpuTensor):
                self.transfers[_line_of_package()] += 1
        return result


class _FromLists(TorchFunctionMode):
    """Sees what makes a tensor from a list: not an operation."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if function in (torch.tensor, torch.as_tensor) and _is_gpu(kwargs.get("device", "cpu")):
            return function(*args, **(kwargs | {"device": "cpu"})).to(GPU)
        return function(*args, **kwargs)


class _InThisThread:
    """Computes at once what would go to another thread, which those two do not see."""

    def submit(self, function: Callable[..., Any], *call: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*call))
        return future


@contextmanager
def pretended_gpu() -> Iterator[Counter[str]]:
    """Make the device GPU usable; yield how many tensors each line brought back to the CPU."""
    transfers: Counter[str] = Counter()
    with _FromLists(), _Calls(transfers), patch.object(threads, "_POOL", _InThisThread()):
        yield transfers


def _run(function: Any, args: tuple, kwargs: dict[str, Any]) -> Any:
    """Do an operation on what is inside of its tensors."""
    tensors: list[Tensor] = []
    inner_args = tuple(_inside(arg, tensors) for arg in args)
    inner = {name: _inside(arg, tensors) for name, arg in kwargs.items()}
    device, on_gpu = kwargs.get("device"), any(isinstance(t, GpuTensor) for t in tensors)
    if function is _COPY:
        is_gpu = isinstance(args[0], GpuTensor)
    elif device is not None:
        is_gpu, inner["device"] = _is_gpu(device), torch.device("cpu")
        if not is_gpu and not on_gpu:
            inner["device"] = device
    else:
        is_gpu = on_gpu
        if on_gpu and function is not _COPY_TO:
            _refuse_two_devices(function, args, tensors)
    result = function(*inner_args, **inner)
    if function._schema.is_mutable and result is not None:
        return kwargs.get("out", args[0])
    if function is _COPY_TO and result is inner_args[0]:
        result = result.clone()
    return _wrapped(result) if is_gpu else result


def _inside(value: Any, found: list[Tensor]) -> Any:
    if isinstance(value, Tensor):
        found.append(value)
        return value.inside if isinstance(value, GpuTensor) else value
    return [_inside(item, found) for item in value] if isinstance(value, list) else value


def _wrapped(value: Any) -> Any:
    if isinstance(value, Tensor):
        return GpuTensor(value)
    return type(value)(map(_wrapped, value)) if type(value) in (list, tuple) else value


def _refuse_two_devices(function: Any, args: tuple, tensors: list[Tensor]) -> None:
    written_on_cpu = function._schema.is_mutable and not isinstance(args[0], GpuTensor)
    if function in _INDEXING and isinstance(args[0], GpuTensor):
        tensors = [part for part in args if isinstance(part, Tensor)]
    others = [t for t in tensors if not isinstance(t, GpuTensor)]
    if written_on_cpu or any(t.dim() > 0 for t in others):
        shapes = ", ".join(str(tuple(t.shape)) for t in others)
        raise RuntimeError(f"{function} on two devices, {shapes} on the CPU: {_line_of_package()}")


def _place(place: Any) -> tuple:
    """Move the indices of the CPU, because torch would do so out of our sight."""

    def on_gpu(part: Any) -> Any:
        is_many = isinstance(part, list) or (isinstance(part, Tensor) and part.dim() > 0)
        return torch.as_tensor(part).to(GPU) if is_many else part

    return tuple(map(on_gpu, place if isinstance(place, tuple) else (place,)))


def _is_gpu(device: Any) -> bool:
    return torch.device(device).type == GPU


def _line_of_package() -> str:
    """Return the line of minislam that is being run, the innermost one."""
    for frame, line in traceback.walk_stack(sys._getframe()):
        path = Path(frame.f_code.co_filename)
        if PACKAGE in path.parents:
            return f"{path.relative_to(PACKAGE)}:{line}"
    return "outside"
