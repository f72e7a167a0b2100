"""When nothing measures depth: a camera that stands still or only turns."""

from types import SimpleNamespace

from minislam.tracking.safeguards.diagnostics import Watch


def test_a_single_keyframe_with_parallax_tells_that_the_camera_walked():
    watch = Watch(SimpleNamespace(least_parallax=1.0))
    for parallax, expected in ((0.9, True), (1.1, False)):
        watch.diagnostics = [SimpleNamespace(parallax=p) for p in (0.0, parallax, 0.0)]
        assert watch.only_turned == expected
