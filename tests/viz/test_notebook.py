"""HTML for a notebook's cell: whatever a page or a name holds stays inside its attribute."""

from html import unescape

from minislam.viz import Page, summary_html


def test_a_page_survives_its_frame():
    page = "<p title=\"a & b\">'x'</p><script>if (1 < 2) {}</script>"
    shown = Page(page, 300)._repr_html_()
    start = shown.index('srcdoc="') + len('srcdoc="')
    assert unescape(shown[start : shown.index('"', start)]) == page
    assert 'height="300"' in shown


def test_a_summary_escapes_whatever_it_is_given():
    shown = summary_html("a<b", {"frames": ("3 & 4", "good")}, ["x > y"], b"\x89PNG\r\n")
    assert "a&lt;b" in shown and "3 &amp; 4" in shown and "x &gt; y" in shown and "good" in shown
    assert "iVBOR" in shown
