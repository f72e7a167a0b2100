"""Freed memory stays with the process, and nothing breaks where it cannot."""

import ctypes
import platform
import subprocess
import sys

import pytest

from minislam.allocator import keep_freed_memory

# Pages that the system has to clear while 36 MB are asked for and freed, over and over. Blocks of
# less than 4 MB: for larger ones numpy asks for huge pages, of which there may or may not be some.
COUNT_FAULTS = """
import resource
import numpy as np
from minislam.allocator import keep_freed_memory
{call}
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    blocks = [np.ones(375_000) for _ in range(12)]
    del blocks
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(call: str) -> int:
    script = [sys.executable, "-c", COUNT_FAULTS.format(call=call)]
    return int(subprocess.run(script, capture_output=True, check=True, text=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_memory_is_used_again():
    assert faults("keep_freed_memory()") < 0.5 * faults("pass")


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_another_allocator_is_left_alone(error: type, monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> None:
        raise error(name)

    monkeypatch.setattr(ctypes, "CDLL", missing)
    keep_freed_memory()
