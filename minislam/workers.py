"""Processes that share the work: `Workers.map` computes independent calls side by side.

A helper is a second Python that runs `serve`. Calls and results go through its standard input and
output: the name of a function of this package, plain values, and the bytes of tensors. It never
imports the script of the user, as `multiprocessing` does under spawn.

A helper keeps nothing between two calls, so the result never depends on the helpers: a call whose
helper has ended is computed in this process. A helper ends when its input does; if this process is
killed, after the call that it computes.
"""

import importlib
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from itertools import islice
from threading import Lock, Thread
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from minislam.errors import require
from minislam.records import Frame
from minislam.state.stateful import Tree, from_tree, hints_of, to_tree

MOST_WORKERS = 4  # by default
AT_ONCE = 16  # calls of a stream: with fewer, cores wait for the longest of them more often
_TENSOR = "tensor"  # key of what stands for a tensor in the JSON of a message
_START = "import sys; sys.path[:] = sys.argv[2:]; from minislam.workers import serve; serve()"


def idle_cores() -> int:
    """Return how many workers the idle cores can feed, at most 4; MINISLAM_WORKERS replaces it."""
    if given := os.environ.get("MINISLAM_WORKERS"):
        wanted = "MINISLAM_WORKERS of at least 1 and at most 256"  # as --workers
        is_count = given in map(str, range(1, 257))
        require(is_count, wanted, f"{given!r}; choose a whole number between")
        return int(given)
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    busy = 0.0
    with suppress(AttributeError, OSError):  # of Windows; of a sandbox without /proc/loadavg
        busy = os.getloadavg()[0]
    return max(1, min(MOST_WORKERS, math.ceil(cores - busy)))


class Workers(AbstractContextManager["Workers"]):
    """This process and its helpers; one worker is this process alone."""

    def __init__(
        self,
        count: int = 1,  # processes in all
        threads: int = 1,  # of torch in each helper, as many as here: the bytes depend on it
        warn: Callable[[str], None] = lambda text: None,  # told when helpers are lost
    ) -> None:
        require(count >= 1, "at least 1 worker", f"{count}; give --workers 1 or more")
        if count > (most := os.cpu_count() or count):
            warn(f"{count} workers on {most} processors are slower; give --workers {most} or fewer")
        self._warn = warn
        self._helpers: list[_Helper] = []
        try:
            for _ in range(count - 1):
                self._helpers.append(_Helper(threads))
        except OSError as error:
            warn(f"a worker could not be started ({error}); the run goes on with fewer")

    def close(self, *_: object) -> None:
        """End all helpers, also one that computes: nobody wants its answer any more."""
        for helper in self._helpers:
            helper.end()
        self._helpers = []

    __exit__ = close

    def map(self, function: Callable[..., Any], calls: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Return function(*call) for every call, in their order; what it raises is raised here.

        `function` must stand in a module of this package, with annotated arguments and result:
        tensors, arrays, plain values, and dataclasses, lists or dictionaries of them.
        """
        arguments = [_contiguous(to_tree(list(call))) for call in calls]
        answers: dict[int, Tree] = {}
        left = iter(range(len(calls)))  # each process takes the next

        def compute(answer: Callable[..., Tree]) -> None:
            with suppress(_HelperLost):
                for number in left:
                    answers[number] = answer(function, arguments[number])

        idle = [helper for helper in self._helpers if not helper.lock.locked()]
        helpers = idle[: max(0, len(calls) - 1)]
        threads = [Thread(target=compute, args=(h.answer,), daemon=True) for h in helpers]
        for thread in threads:
            thread.start()
        try:
            compute(_answer)
            for thread in threads:
                thread.join()
            for number in set(range(len(calls))) - set(answers):  # of helpers that were lost
                answers[number] = _answer(function, arguments[number])
        except BaseException:
            self.close()  # else the helpers would go on with what nobody waits for
            raise
        alive = [helper for helper in self._helpers if helper.runs]
        if len(alive) < len(self._helpers):
            self._warn(f"a worker process has ended; the run goes on with {len(alive) + 1}")
        self._helpers = alive
        kind = hints_of(function)["return"]
        return [from_tree(kind, answers[number], _no_frame) for number in range(len(calls))]

    def stream(
        self, function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]
    ) -> Iterator[Any]:
        """Yield what `map` returns. Calls are asked for, and results are kept, a few at a time."""
        left = iter(calls)
        while chunk := list(islice(left, AT_ONCE)):
            yield from self.map(function, chunk)

    def start(self, function: Callable[..., Any], *call: Any) -> Callable[[], Any]:
        """Begin function(*call) in a helper; return what waits for the result, or computes it."""
        arguments = _contiguous(to_tree(list(call)))
        answers: list[Tree] = []

        def ask() -> None:
            for helper in self._helpers[-1:]:
                with suppress(_HelperLost):
                    answers.append(helper.answer(function, arguments))

        def result() -> Any:
            thread.join()
            answer = answers[0] if answers else _answer(function, arguments)
            return from_tree(hints_of(function)["return"], answer, _no_frame)

        thread = Thread(target=ask, daemon=True)
        thread.start()
        return result


class _HelperLost(Exception):
    """A helper has ended before it answered."""


class _Helper:
    """A process that computes calls, one at a time."""

    def __init__(self, threads: int) -> None:
        command = [sys.executable, "-c", _START, str(threads), *sys.path]
        # In a session of its own Ctrl-C does not reach it: the run ends after its present step.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        self.runs = True
        self.lock = Lock()  # while it computes a call

    def answer(self, function: Callable[..., Any], arguments: Tree) -> Tree:
        """Return what `_answer` returns, or raise _HelperLost."""
        try:
            with self.lock:
                _send(self._process.stdin, [function.__module__, function.__name__, arguments])
                return _receive(self._process.stdout)
        except (EOFError, OSError, ValueError) as error:
            self.end()
            raise _HelperLost from error

    def end(self) -> None:
        self.runs = False
        with suppress(OSError), self._process:  # what was not sent is lost with the helper
            self._process.kill()


def serve() -> None:
    """Answer calls from standard input until it ends, or until a call fails."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # the parent decides when it ends
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not get among the answers
    torch.set_num_threads(int(sys.argv[1]))
    cv2.setNumThreads(1)  # as in the process that asks: others need the cores
    try:
        while True:
            module, name, arguments = _receive(sys.stdin.buffer)
            _send(answers, _answer(getattr(importlib.import_module(module), name), arguments))
    except Exception:  # the parent has ended, or computes the call itself and sees the error
        return


def _answer(function: Callable[..., Any], arguments: Tree) -> Tree:
    """Return function(*arguments), both as trees: here as in a helper."""
    *kinds, _ = hints_of(function).values()
    values = [from_tree(k, a, _no_frame) for k, a in zip(kinds, arguments, strict=True)]
    return _contiguous(to_tree(function(*values)))


def _no_frame(index: int) -> Frame:
    raise TypeError(f"expected a call without frames, found frame {index}; give its image")


def _contiguous(tree: Tree) -> Tree:
    """Return a tree with tensors as a pipe carries them: the layout can change the last bits."""
    if isinstance(tree, dict):
        return {key: _contiguous(item) for key, item in tree.items()}
    if isinstance(tree, list):
        return [_contiguous(item) for item in tree]
    if isinstance(tree, np.ndarray):
        return torch.from_numpy(tree).contiguous()
    return tree.detach().contiguous() if isinstance(tree, Tensor) else tree


def _send(stream: Any, tree: Tree) -> None:
    """Write a line of JSON, and the bytes of the tensors that it names."""
    tensors: list[Tensor] = []

    def named(tensor: Tensor) -> Tree:  # called in the order of the text
        tensors.append(tensor)
        return {_TENSOR: [str(tensor.dtype).removeprefix("torch."), list(tensor.shape)]}

    stream.write(json.dumps(tree, default=named).encode() + b"\n")
    for tensor in tensors:
        stream.write(_bytes(tensor))
    stream.flush()


def _receive(stream: Any) -> Tree:
    """Read what `_send` has written, or raise EOFError or ValueError."""

    def filled(node: dict[str, Any]) -> Tree:  # called in the order of the text
        if _TENSOR not in node:
            return node
        name, shape = node[_TENSOR]
        tensor = torch.empty(shape, dtype=getattr(torch, name))
        if stream.readinto(_bytes(tensor)) != tensor.nbytes:
            raise EOFError
        return tensor

    return json.loads(stream.readline(), object_hook=filled)


def _bytes(tensor: Tensor) -> memoryview:
    """Return the memory of a contiguous tensor of any type; numpy knows no bfloat16."""
    return tensor.reshape(-1).view(torch.uint8).numpy().data
