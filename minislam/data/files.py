"""Write files atomically; read them, or say in one sentence why they cannot be read."""

import json
import math
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from minislam.errors import InputError, require

Json = dict[str, Any]  # the content of a JSON file


def atomic_write(path: Path | str, content: bytes) -> None:
    """Write a file so that a crash leaves the old file or the new one, never half of one."""
    with atomic_file(path) as file:
        file.write(content)


@contextmanager
def atomic_file(path: Path | str) -> Iterator[BinaryIO]:
    """Open a file to be written as a whole or not at all.

    The bytes go to a temporary file beside it, reach the disk, and then take the final name. What
    a link points to is replaced, not the link. Devices, pipes and folders are refused.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise InputError(f"expected a file to write, but {path} is none; choose another name")
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:  # an interruption, too, leaves nothing half written behind
        if temporary.is_file():
            temporary.unlink()
        if not isinstance(error, OSError):
            raise
        reason = f"{error.strerror or error}; choose a writable folder with space left"
        raise InputError(f"expected to be able to write {path}, but: {reason}") from error


def require_free(folder: Path | str, overwrite: bool, also: str = "") -> None:
    """Refuse an output folder that holds files, unless it may be overwritten."""
    require_no_file(folder := Path(folder))
    is_free = overwrite or not os.path.isdir(folder) or not any(folder.iterdir())
    found = f"files in {folder}; choose another name or add --overwrite{also}"
    require(is_free, "a new or empty output folder", found)


def require_new(files: Iterable[Any], overwrite: bool, inputs: Iterable[Path | str]) -> None:
    """Refuse output files that exist, are inputs or cannot be written, before the work begins."""
    files = list(filter(None, files))  # None: not asked for
    real = [os.path.realpath(path) for path in files]
    if twice := [path for path in files if real.count(os.path.realpath(path)) > 1]:
        raise InputError(f"expected files of different names, found {twice[0]} twice; rename one")
    for path in files:
        folder, wrong = os.path.dirname(os.path.realpath(path)), ""
        if not (os.path.isdir(folder) and os.access(folder, os.W_OK)):
            wrong = f"{folder} is no writable folder; make it, or choose another"
        elif os.path.exists(path):
            wrong = "" if overwrite else f"{path} exists; choose another name or add --overwrite"
            if any(os.path.samefile(path, file) for file in filter(os.path.exists, inputs)):
                wrong = f"{path} exists and is an input; choose another name"
        if wrong:
            raise InputError(f"expected a new file, but {wrong}")


def make_folder(path: Path) -> None:
    """Make an output folder and those above it, or say in one sentence why it cannot be."""
    require_no_file(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        text = f"expected to make the folder {str(path)[:300]}, but the system says: {reason}"
        raise InputError(f"{text}; choose another name, or change its permissions") from error


def require_no_file(folder: Path) -> None:
    """Refuse an output folder that is a file, or that would lie below one."""
    for path in (folder, *folder.parents):
        if os.path.exists(path) and not os.path.isdir(path):  # names of any length
            raise InputError(
                f"expected an output folder, but {path} is a file; choose another name"
            )


def write_text(path: Path | str, text: str) -> None:
    """Write a UTF-8 text file atomically, with Unix line ends on every system.

    Bytes of a file name that are no UTF-8 become escapes, which JSON turns back into those bytes.
    """
    atomic_write(path, text.encode("utf-8", "backslashreplace"))


def write_json(path: Path | str, content: Any) -> None:
    """Write JSON atomically; NaN and infinity, which JSON does not know, become null."""
    finite = json.loads(json.dumps(content), parse_constant=lambda name: None)
    write_text(path, json.dumps(finite, indent=2, ensure_ascii=False) + "\n")


def read_bytes(path: Path | str) -> bytes:
    """Return the content of a file, or say in one sentence why it cannot be read."""
    try:
        return Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = f"the system says: {getattr(error, 'strerror', None) or error}; check the path"
        raise InputError(f"expected a readable file {path}, but {reason}") from error


def read_text(path: Path | str) -> str:
    """Return a UTF-8 text file; a byte order mark and Windows line ends are accepted."""
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = f"byte {error.start} of {path} is not text; check the path"
        raise InputError(f"expected a UTF-8 text file, but {found}") from error


def read_json(path: Path | str) -> Any:
    """Return the content of a JSON file."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # also a number of 5000 digits
        raise InputError(f"expected JSON in {path}, found an error: {error}; correct it") from error


def data_rows(text: str, name: str) -> list[tuple[str, str]]:
    """Return ("line 7 of NAME", content) of the lines that are neither empty nor comments (#)."""
    rows = [(f"line {n} of {name}", row.strip()) for n, row in enumerate(text.splitlines(), 1)]
    return [(where, row) for where, row in rows if row and not row.startswith("#")]


def finite_numbers(fields: list[str], where: str) -> list[float]:
    """Return the fields as finite numbers; `where` (file and line) goes into the error."""
    with suppress(ValueError):
        numbers = [float(field) for field in fields]
        if all(map(math.isfinite, numbers)):
            return numbers
    shown = " ".join(fields)[:80]
    is_table = "," in shown and re.fullmatch(r"[-+\deE.,;\s]+", shown)
    hint = "separate columns by spaces, and write decimal points" if is_table else "correct it"
    raise InputError(f"expected finite numbers in {where}, found '{shown}'; {hint}")
