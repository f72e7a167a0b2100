"""A whole test run executes the notebooks in a second process, on the second core.

Plain `pytest` does so, on a machine with two cores. A run of chosen tests or files does not.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"


class NotebooksBeside:
    """The plugin of a whole run: leaves the notebooks to a second process, reports it."""

    def __init__(self, config: pytest.Config) -> None:
        config.args = [folder for folder in config.args if Path(folder).name != NOTEBOOKS.name]
        self._output = tempfile.TemporaryFile(mode="w+", encoding="utf-8")
        command = [sys.executable, "-m", "pytest", str(NOTEBOOKS), "-q"]
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
        terminalreporter.section("notebooks, in a process of their own")
        terminalreporter.write(self._output.read())


def is_whole(config: pytest.Config) -> bool:
    """Tell whether all tests run, on a machine with two cores."""
    chosen = config.option.markexpr or config.option.keyword or config.option.collectonly
    is_plain = config.args_source == pytest.Config.ArgsSource.TESTPATHS
    return is_plain and not chosen and (os.cpu_count() or 1) > 1
