"""Call a student's function: on copies, for a limited time, and tell where it stops."""

import copy
import signal
import sysconfig
import threading
import time
import traceback
from _thread import interrupt_main
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from minislam.geometry import Camera

# Code that is not the student's.
LIBRARIES = (
    "<string>",  # the methods that dataclasses write
    "<frozen ",  # modules of Python itself, like runpy
    str(Path(__file__).parents[1]),
    *map(sysconfig.get_path, ("stdlib", "purelib", "platlib")),
)
PLAIN = (Tensor, np.ndarray, list, tuple, int, float, str, Camera, type(None))


class Stopped(Exception):
    """A function that came to no answer; the text completes "it ..."."""


def call(
    function: Callable[..., Any], arguments: tuple[Any, ...], seconds: float
) -> tuple[Any, tuple[Any, ...]]:
    """Return a function's answer, and the arguments that it was given.

    It gets copies, in the default dtype of the notebook, and, where it mixes dtypes, the numbers
    as they are. Raises Stopped with the line where it stops, and NotImplementedError from a stub.
    """
    is_plain = all(isinstance(argument, PLAIN) for argument in arguments)
    dtype = torch.get_default_dtype() if is_plain else None
    while True:
        given = _copied(arguments, dtype)
        try:
            with time_limit(seconds):
                return function(*given), given
        except TimeoutError:
            raise Stopped(f"has no answer after {seconds:.1f} seconds (an endless loop?)") from None
        except (Exception, SystemExit) as error:  # any mistake is an answer, not a crash
            if isinstance(error, NotImplementedError) and not error.args:
                raise  # a stub; what torch cannot do, it says
            mixes = isinstance(error, RuntimeError) and "type" in str(error)  # "dtype", "type"
            if dtype is None or not mixes:
                raise Stopped(_story(error)) from None
            dtype = None


def _copied(value: Any, dtype: torch.dtype | None) -> Any:
    """Return a copy, with all tensors of real numbers in a dtype unless it is None."""
    if isinstance(value, Tensor):
        return value.clone().to(dtype if dtype and value.is_floating_point() else value.dtype)
    if type(value) in (list, tuple):
        return type(value)(_copied(part, dtype) for part in value)
    return copy.deepcopy(value)


def _story(error: BaseException) -> str:
    """Return "stops with KIND: message, in line 3: text"."""
    message = " ".join(str(error).split())[:200].rstrip(".")
    story = f"stops with {type(error).__name__}" + f": {message}" * bool(message)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith(LIBRARIES):
            return f"{story}, in line {frame.lineno}" + f": {frame.line}" * bool(frame.line)
    return story


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError inside the block after so many seconds of work, on every system.

    A second thread presses Ctrl-C for the first one, again and again. One long call into compiled
    code ends only when it returns; outside the main thread there is no limit.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    finished, pressed = threading.Event(), threading.Event()

    def watch() -> None:
        begin, worked = time.monotonic(), time.process_time()
        while not finished.wait(min(seconds, 0.5)):
            waited = time.monotonic() - begin
            # On a busy machine, a short piece of work may take long.
            if min(waited, time.process_time() - worked) >= seconds or waited >= 10 * seconds:
                pressed.set()
                interrupt_main()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        try:
            yield
        finally:
            finished.set()
            watcher.join()
    except KeyboardInterrupt:
        finished.set()  # the key may have been pressed just before the line above
        watcher.join()
        if pressed.is_set():
            raise TimeoutError from None
        raise  # the user's own
