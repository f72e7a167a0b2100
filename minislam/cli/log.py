"""log.txt of a run folder: what a command printed, and when."""

import contextlib
import io
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from minislam.data.run_folder import LOG, RUN


class Log:
    """Keeps what is printed, with the time of each line, until the run in its folder has begun."""

    def __init__(self) -> None:
        self._folder: Path | None = None
        self._earlier: int | None = None  # when run.json of an earlier run was written [ns]
        self.is_begun = False  # something is in the file
        self._lines: list[str] = []  # not written yet
        self._begun = ""  # a line whose end is not printed yet

    def write_into(self, folder: Path) -> None:
        """Write into a folder, but only once run.json, written as a run begins, is this run's."""
        self._folder, self._earlier = folder, _written(folder)

    def add(self, text: str) -> None:
        """Take what is printed. Of a progress line on a terminal, the last state is kept."""
        *lines, self._begun = (self._begun + text).split("\n")
        now = time.strftime("%Y-%m-%d %H:%M:%S")
        states = (line.rpartition("\r")[2].rstrip() for line in lines)
        self._lines += [f"{now}  {state}\n" for state in states]
        if self._folder and self._lines and _written(self._folder) not in (None, self._earlier):
            with contextlib.suppress(OSError):  # a full disk ends no run
                with open(self._folder / LOG, "a", encoding="utf-8", errors="replace") as file:
                    file.writelines(self._lines)
                self._lines, self.is_begun = [], True


def _written(folder: Path) -> int | None:
    """Return when run.json of a folder was written [ns], None if there is none."""
    with contextlib.suppress(OSError):
        return (folder / RUN).stat().st_mtime_ns
    return None


class _Recorded(io.TextIOBase):
    """A stream that gives what is printed to a log, too, and prints nothing if it is silent."""

    def __init__(self, stream: TextIO, log: Log, is_silent: bool) -> None:
        self._stream, self._log, self._is_silent = stream, log, is_silent

    def write(self, text: str) -> int:
        """Print and record. A reader that has ended, or a full disk, ends only the printing."""
        self._log.add(text)
        try:
            if not self._is_silent:
                self._stream.write(text)
                self._stream.flush()
        except (OSError, ValueError):  # ValueError: a closed file
            self._is_silent = True
        return len(text)

    def isatty(self) -> bool:
        return self._stream.isatty()


@contextlib.contextmanager
def recorded(is_quiet: bool) -> Iterator[Log]:
    """Give what is printed to a log; if it shall be quiet, print only what goes to stderr."""
    log = Log()
    out, err = _Recorded(sys.stdout, log, is_quiet), _Recorded(sys.stderr, log, False)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            yield log
        except BaseException as error:
            if log.is_begun:  # a run that is refused leaves the folder as it is
                log.add(f"minislam: {str(error) or type(error).__name__}\n")
            raise
