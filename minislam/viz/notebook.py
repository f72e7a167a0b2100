"""What a notebook shows of a run: HTML that a cell displays, without any library."""

import base64
from collections.abc import Mapping
from collections.abc import Sequence as Series
from html import escape


class Page:
    """A whole HTML page, shown inside a notebook's cell."""

    def __init__(self, html: str, height: int) -> None:
        self.html = html
        self.height = height  # px

    def _repr_html_(self) -> str:
        """Return the page in a frame of its own, so that its styles stay inside."""
        return (
            f'<iframe srcdoc="{escape(self.html)}" width="100%" height="{self.height}" '
            'style="border: 0"></iframe>'
        )


def summary_html(
    title: str,
    lines: Mapping[str, tuple[str, str]],  # what -> its value, and whether that is good
    warnings: Series[str],
    png: bytes,
) -> str:
    """Return the HTML of a small summary: title, lines, warnings, one picture."""
    left = 'style="text-align: left"'
    rows = "".join(
        f"<tr><th {left}>{escape(what)}</th><td {left}>{escape(value)}</td>"
        f"<td {left}>{escape(verdict)}</td></tr>"
        for what, (value, verdict) in lines.items()
    )
    notes = "".join(f"<p><b>Warning:</b> {escape(warning)}</p>" for warning in warnings)
    data = base64.b64encode(png).decode("ascii")
    picture = f'<img src="data:image/png;base64,{data}" alt="input, uncertainty, map, path">'
    return f"<h4>{escape(title)}</h4><table>{rows}</table>{notes}{picture}"
