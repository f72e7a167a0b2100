"""Threads of this process, for long calls of torch or OpenCV; processes are in workers.py."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

THREADS = 2
_POOL = ThreadPoolExecutor(THREADS)


def side_by_side(function: Callable[..., Any], calls: Iterable[tuple[Any, ...]]) -> Iterator[Any]:
    """Yield function(*call) of each call, in their order; threads compute a few of them at once.

    Worth it for calls of a millisecond and more, because torch and OpenCV release the
    interpreter's lock. A call must not change what another reads, nor ask for `side_by_side`.
    """
    pending: deque[Future[Any]] = deque()
    for call in calls:
        pending.append(_POOL.submit(function, *call))
        if len(pending) > THREADS:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()
