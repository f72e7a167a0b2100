"""What a report says of settings and next steps, and when one is written before the end."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np

from minislam.config import preset
from minislam.runs import pictures
from minislam.runs.pictures import MAX_SHOWN, Preview, named_settings


def test_settings_are_named_by_the_nearest_preset():
    assert named_settings(preset("test")) == "preset test"
    assert named_settings(preset("paper-fast")) == "preset paper-fast"
    config = replace(preset("laptop"), seed=4)
    assert named_settings(config) == "preset laptop with seed 4 instead of 0"


def test_of_many_keyframes_some_are_shown_the_first_and_the_last_among_them():
    assert pictures._spread(3, MAX_SHOWN) == [0, 1, 2] and pictures._spread(0, MAX_SHOWN) == []
    many = pictures._spread(1000, MAX_SHOWN)
    assert len(many) == MAX_SHOWN and (many[0], many[-1]) == (0, 999)


def test_a_preview_waits_for_a_map_and_then_keeps_its_share_of_the_time(monkeypatch):
    now, written = [100.0], []
    monkeypatch.setattr(pictures.time, "perf_counter", lambda: now[0])
    preview = Preview(None)

    def write(folder: object, slam: object, facts: dict) -> None:
        assert facts == {"state": "running"}
        written.append(now[0])
        now[0] += 0.5  # second that it takes

    def facts_of(state: str, exit_code: None) -> dict:
        return {"state": state}

    monkeypatch.setattr(pictures, "write_preview", write)
    slam = SimpleNamespace(mapper=SimpleNamespace(images=[]))
    preview.update(slam, facts_of)
    assert written == []  # no map yet
    slam.mapper.images.append(object())
    for _ in range(200):
        preview.update(slam, facts_of)
        now[0] += 1.0
    assert written[0] == 100.0 and len(written) == 4
    assert 0.5 / (written[1] - written[0]) <= pictures.PREVIEW_FRACTION


def test_a_preview_never_ends_a_run():
    slam = SimpleNamespace(mapper=SimpleNamespace(images=[None]))
    pictures.write_preview(None, slam, {})  # the run has no picture to show, and the folder is none


def test_a_report_has_the_warnings_of_its_run(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "summarise", lambda *_: {})
    sequence = SimpleNamespace(name="clip", description="two images")
    slam = SimpleNamespace(sequence=sequence, config=preset("test"))
    facts = {"command": ["minislam", "run"], "state": "finished", "unit": "m"}
    facts["warnings"] = ["the camera hardly moved"]
    shown = {"overview": b"", "figures": {}}
    pictures._write_report(SimpleNamespace(path=tmp_path), slam, {}, facts, **shown)
    assert "the camera hardly moved" in (tmp_path / pictures.REPORT).read_text(encoding="utf-8")


def test_depth_and_beta_of_keyframes_are_written_in_colours(monkeypatch):
    numbers, image, written = np.linspace(0.5, 2, 48).reshape(6, 8), np.zeros((6, 8, 3)), {}
    panels = {"input": image, "depth": numbers, "beta": numbers, "render": image}
    monkeypatch.setattr(pictures, "_panels", lambda slam, k: (dict(panels) for _ in k))
    views = [SimpleNamespace(inserts=True, frame_index=7)]
    folder = SimpleNamespace(write_image=written.__setitem__, remove_other_keyframes=lambda _: None)
    pictures._write_keyframes(folder, SimpleNamespace(mapper=SimpleNamespace(images=views)))
    for kind in ("depth", "beta"):
        content = np.frombuffer(written[f"keyframes/000007_{kind}.png"], np.uint8)
        blue, _, red = cv2.split(cv2.imdecode(content, cv2.IMREAD_COLOR))
        assert (blue != red).any()
