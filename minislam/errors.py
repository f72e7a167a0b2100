"""The errors a user can meet. Everything else is a bug of ours and may show a traceback."""

import difflib
from collections.abc import Iterable

# Exit codes: a known error, wrong usage, a run not to be trusted as a whole, an interruption.
FAILED_EXIT, USAGE_EXIT, LOST_EXIT, INTERRUPTED_EXIT = 1, 2, 3, 130


class MinislamError(Exception):
    """Base of all known errors: the command line prints its one sentence and exits with code 1."""


class InputError(MinislamError):
    """What was given cannot be used. The sentence says what was expected, found, and what to do."""


def require(is_right: bool, wanted: str, found: object) -> None:
    """Raise InputError unless right: "expected WANTED, found FOUND", which ends with what to do."""
    if not is_right:
        raise InputError(f"expected {wanted}, found {found}")


def nearest(name: str, known: Iterable[str], otherwise: str) -> str:
    """Return a hint at the most similar of the known names, or `otherwise` if none is similar."""
    near = difflib.get_close_matches(name, known, n=1)
    return f"the nearest is {near[0]}" if near else otherwise
