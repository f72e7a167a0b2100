"""Every run has a plan: the stages it goes through, and what each takes."""

from unittest.mock import MagicMock

import pytest

from minislam.cli.run import DEMO
from minislam.config import PRESETS, preset
from minislam.geometry import Camera
from minislam.priors.choice import PriorChoice
from minislam.runs.run import plan_of


def planned(name: str, choice: PriorChoice, frames: int = 60) -> list[dict[str, float]]:
    sequence = MagicMock(camera=Camera(300, 300, 160, 120, 320, 240), refines_focal=False)
    sequence.__len__.return_value = frames
    return plan_of(preset(name), choice, sequence)


def test_the_demo_is_planned_for_some_two_minutes_of_one_core():
    plan = planned("laptop", PriorChoice(depth="simulated"), frames=DEMO["max_frames"])
    assert sum(seconds for stage in plan for seconds in stage.values()) < 150  # 142 today


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("has_prior", [True, False])
def test_a_plan_has_the_stages_of_the_run(name: str, has_prior: bool):
    plan = planned(name, PriorChoice(depth="sensor" if has_prior else "none"))
    shown = [part for stage in plan for part in stage if part]
    assert shown[0] == "tracking and mapping" and "dense depth" in shown
    assert min(seconds for stage in plan for seconds in stage.values()) >= 0
    assert shown.count("first map") == 1 + has_prior and len(plan) == 6 + (name == "paper")
