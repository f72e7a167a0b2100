"""The report: one HTML page, escaped, its pictures inside, the same bytes for the same run."""

import json
import re

import numpy as np

from minislam.viz import (
    Report,
    build_report,
    depth_to_rgb,
    figure_png,
    new_figure,
    summary_html,
)

PNG = figure_png(new_figure((2, 2)), dpi=20)
JPEGS = {0: [b"input", b"depth", b"beta", b"map"], 7: [b"i", b"d", b"b", b"m"]}


def report(**parts: object) -> str:
    return build_report(Report("run <1>", "out/my", parts.pop("state", "finished"), **parts))


def test_a_report_shows_its_pictures_without_the_rest_of_the_folder():
    html = report(
        summary=[("ATE", "1 & 2 cm", "good", "a < b", "")],
        warnings=["focal length <guessed>"],
        figures=[("a < b", PNG)],
        keyframes=JPEGS,
    )
    assert html.startswith("<!DOCTYPE html>") and "http" not in html
    assert "run &lt;1&gt;" in html and "1 &amp; 2 cm" in html and html.count("a &lt; b") == 3
    assert '<span class="good">good</span>' in html
    assert '<p class="warning">focal length &lt;guessed&gt;</p>' in html
    assert html.count("data:image/png;base64,") == 1
    # Viewer and clip are files of their own, asked for by the script and shown when they are there.
    assert re.findall(r'src="(?!data:)([^"]*)"', html) == []
    assert html.count('class="waiting ended"') == 3 and 'viewer.src = "viewer.html"' in html
    assert html == report(
        summary=[("ATE", "1 & 2 cm", "good", "a < b", "")],
        warnings=["focal length <guessed>"],
        figures=[("a < b", PNG)],
        keyframes=JPEGS,
    )


def test_a_part_that_is_not_known_is_not_shown():
    html = report()
    assert 'id="pictures">[]</script>' in html
    assert 'else document.getElementById("keyframes").remove();' in html
    # Plots come last: without them a run has ended early, and has neither viewer nor clip.
    assert "main:not(:has(#figures img)) .ended" in html and '<details class="ended">' in html
    assert ".failed .resume" in html


def test_long_names_and_plots_fit_a_phone():
    assert "overflow-wrap: anywhere" in report()
    assert ".wide, #figures figure { overflow-x: auto; }" in report()


def test_the_slider_reaches_every_keyframe():
    html = report(keyframes=JPEGS)
    pages = json.loads(re.search(r'id="pictures">(.*?)</script>', html)[1])
    assert [frame for frame, _ in pages] == [0, 7] and all(len(urls) == 4 for _, urls in pages)
    assert "slider.max = keyframes.length - 1" in html
    # The first is shown before the slider moves, and no empty picture without scripts.
    assert html.count("  showKeyframe();\n  reveal(slider);") == 1


def test_the_scales_say_their_numbers_in_the_colours_of_the_pictures():
    html = report(keyframes=JPEGS, depth_limits=(1.0, 5.0), beta_limits=(0.1, 10.0), unit="m")
    numbers = re.findall(r"<span>([^<]*)</span>", html)
    assert numbers == ["1", "3", "5 m", "0.1", "1", "10 "]  # beta is coloured by its logarithm
    red, green, blue = 255 * depth_to_rgb(np.array([[5.0]]), (1.0, 5.0))[0, 0]
    assert f"rgb({red:.0f} {green:.0f} {blue:.0f})" in html


def test_settings_and_commands_are_said():
    html = report(command="minislam run a.mp4", settings="preset test with seed 4 instead of 0")
    assert "<p>Settings: preset test with seed 4 instead of 0.</p>" in html
    assert "<pre>minislam run a.mp4</pre>" in html and "minislam render out/my --path" in html
    html = report(next_step="go on with: minislam run --resume -o <my>")
    assert "<pre>go on with: minislam run --resume -o &lt;my&gt;</pre>" in html


def test_the_end_of_the_run_decides_what_is_shown():
    states = {
        "running": "running",
        "finished": "finished",
        "finished, broken": "finished flawed",
        "finished, most bundle adjustments failed": "finished flawed",  # not "failed"
        "interrupted": "interrupted",
        "failed: disk full, again": "failed",
    }
    for state, kind in states.items():
        html = report(state=state)
        assert f'<main class="{kind}">' in html and f'<span class="state">{state}</span>' in html


def test_a_summary_escapes_whatever_it_is_given():
    shown = summary_html("a<b", [("frames", "3 & 4", "good", "", "")], ["x > y"], b"\x89PNG\r\n")
    assert "a&lt;b" in shown and "3 &amp; 4" in shown and "x &gt; y" in shown and "good" in shown
    assert "iVBOR" in shown
