"""Fetch a file from the network, only when a command asks for it. A run never does."""

import os
from collections.abc import Callable
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from minislam.errors import InputError

_BLOCK = 1 << 18  # bytes between two reports of the progress
_TIMEOUT = 60  # second without any answer
_RANGE_GIVEN, _NOTHING_LEFT = 206, 416  # HTTP status


def download(
    url: str,
    path: Path,
    check: Callable[[Path], None],  # raises InputError if the whole file is not the right one
    show: Callable[[int, int], None],  # bytes done, of all
) -> None:
    """Fetch a file to a path, once all is checked in PATH.part, which the next call continues."""
    part = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _append(url, part, show)
    except (OSError, HTTPException) as error:
        advice = "the same command goes on where this one ended, or put the file there by hand"
        raise InputError(f"expected to fetch {url} to {path}, but: {error}; {advice}") from error
    try:
        check(part)
    except InputError as error:
        part.unlink()
        raise InputError(f"{error}; what was fetched is removed") from error
    os.replace(part, path)


def _append(url: str, part: Path, show: Callable[[int, int], None]) -> None:
    done = part.stat().st_size if part.exists() else 0
    request = Request(url, headers={"Range": f"bytes={done}-"} if done else {})
    try:
        answer = urlopen(request, timeout=_TIMEOUT)
    except HTTPError as error:
        if error.code == _NOTHING_LEFT and done:
            return
        raise
    with answer, open(part, "ab") as file:
        if done and answer.status != _RANGE_GIVEN:  # the server sends all of it again
            file.truncate(0)
            done = 0
        total = done + int(answer.headers.get("Content-Length") or 0)
        while block := answer.read(_BLOCK):
            file.write(block)
            done += len(block)
            show(done, max(done, total))
        file.flush()
        os.fsync(file.fileno())
    if done < total:
        raise ConnectionError(f"the connection ended after {done} of {total} bytes")
