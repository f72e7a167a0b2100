"""The report: one HTML file, escaped, the same bytes for the same run."""

from minislam.viz import build_report, figure_png, new_figure


def test_a_report_needs_no_other_file():
    png = figure_png(new_figure((2, 2)), dpi=20)
    html = build_report("run <1>", {"ATE": "1 & 2"}, ["focal length guessed"], [("a < b", png)])
    assert html.startswith("<!DOCTYPE html>")
    assert "run &lt;1&gt;" in html and "1 &amp; 2" in html and "a &lt; b" in html
    assert '<p class="warning">focal length guessed</p>' in html
    assert html.count("data:image/png;base64,") == 1
    assert "<script" not in html and "http" not in html
    assert html == build_report(
        "run <1>", {"ATE": "1 & 2"}, ["focal length guessed"], [("a < b", png)]
    )
