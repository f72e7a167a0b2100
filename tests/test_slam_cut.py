"""A film that is cut: tracking and the online map begin anew with its longest part."""

from dataclasses import replace

import pytest

from minislam.config import preset, with_settings
from minislam.data.options import InputOptions
from minislam.data.sequence import open_sequence
from minislam.priors.choice import PriorChoice
from minislam.records import Frame
from minislam.runs.run import choose_priors
from minislam.slam import Slam
from tests.brief import brief_runs

pytestmark = pytest.mark.slow

CUT, FRAMES = 18, 40


def test_the_online_map_holds_the_longest_part_alone(monkeypatch):
    sequence = open_sequence("synth:ball:3", InputOptions(max_frames=FRAMES, size=(160, 120)))
    read = sequence.frame

    def of_two_scenes(index: int) -> Frame:
        frame = read(index)
        return replace(frame, pixels=frame.pixels.flip(1)) if index < CUT else frame

    with brief_runs():
        config = with_settings(preset("test"), {"tracking.warmup_keyframes": 3})
        slam = Slam(
            sequence, config, choose_priors(PriorChoice(depth="simulated"), sequence, config)
        )
        monkeypatch.setattr(sequence, "frame", of_two_scenes)
        parts, begun = [], slam._new_mapper

        def new_mapper(cell: int):
            parts.append([keyframe.frame_index for keyframe in slam.mapper.images])
            return begun(cell)

        monkeypatch.setattr(slam, "_new_mapper", new_mapper)
        for stage in ("adjust_all", "adjust_again", "pose_all_frames", "rebuild_map", "refine_map"):
            monkeypatch.setattr(slam, f"_{stage}", lambda: None)
        slam.run()
    assert len(parts) == 1 and parts[0][0] == 0 and len(parts[0]) >= 3  # it had been begun
    mapped = [keyframe.frame_index for keyframe in slam.mapper.images]
    assert mapped == [frame.frame_index for frame in slam.tracker.keyframes.frames]
    assert mapped[0] == CUT and mapped[-1] > CUT + 10
    assert set(slam.mapper.gaussians.anchor_keyframe.tolist()) <= set(range(len(mapped)))
