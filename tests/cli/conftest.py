"""Runs that the tests of the command line start in this process are brief."""

from collections.abc import Iterator

import pytest

from tests.brief import brief_runs


@pytest.fixture(scope="module", autouse=True)
def brief() -> Iterator[None]:
    with brief_runs():
        yield
