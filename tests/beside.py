"""A whole test run has two processes, each about half of the work, for two cores.

Plain `pytest` starts the second one, on a machine with two cores. A run of chosen tests or files
does not.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BESIDE = ("notebooks", "tests/cli", "tests/runs")  # what the second process runs


class HalfBeside:
    """The plugin of a whole run: leaves `BESIDE` to a second process, and reports it."""

    def __init__(self, config: pytest.Config) -> None:
        beside = [str(ROOT / folder) for folder in BESIDE]
        config.option.ignore = [*(config.option.ignore or []), *beside]
        config.args = [folder for folder in config.args if folder not in BESIDE]
        self._output = tempfile.TemporaryFile(mode="w+", encoding="utf-8")
        command = [sys.executable, "-m", "pytest", *beside, "-q"]
        self._process = subprocess.Popen(command, stdout=self._output, stderr=subprocess.STDOUT)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Wait for the other process, and fail if it has failed."""
        if session.exitstatus == pytest.ExitCode.INTERRUPTED:
            self._process.terminate()
        failed = self._process.wait() != 0
        if failed and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print what the other process has printed."""
        self._output.seek(0)
        terminalreporter.section(f"{', '.join(BESIDE)}, in a second process")
        terminalreporter.write(self._output.read())


def is_whole(config: pytest.Config) -> bool:
    """Tell whether all tests run, on a machine with two cores."""
    chosen = config.option.markexpr or config.option.keyword or config.option.collectonly
    is_plain = config.args_source == pytest.Config.ArgsSource.TESTPATHS
    return is_plain and not chosen and (os.cpu_count() or 1) > 1
