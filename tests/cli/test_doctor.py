"""Doctor tries the installation out, and says if something is wrong with it."""

import pytest

from minislam.cli.main import main
from minislam.priors import conformance


def test_doctor_says_what_is_installed_and_tries_the_flow(capsys: pytest.CaptureFixture[str]):
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "torch " in out and "self-test   flow of a shifted image, off by 0.0" in out


def test_a_flow_that_is_wrong_is_one_sentence(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(conformance, "flow_error", lambda *_: float("nan"))
    assert main(["doctor"]) == 1
    assert "expected the self-test to be exact to 0.1 px, found nan px" in capsys.readouterr().err
