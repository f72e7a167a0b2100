"""The report of a run: one HTML file that needs no other file, no network and no script."""

import base64
from collections.abc import Mapping
from collections.abc import Sequence as Series
from html import escape

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em;
       color: #222; background: #fff; }
table { border-collapse: collapse; }
td, th { padding: 0.2em 1em 0.2em 0; text-align: left; vertical-align: top; }
tr + tr { border-top: 1px solid #ddd; }
.warning { border-left: 4px solid #e08000; background: #fff6e8; padding: 0.4em 0.8em; }
figure { margin: 1.5em 0; } img { max-width: 100%; } figcaption { color: #555; }
""".strip()


def build_report(
    title: str,
    summary: Mapping[str, str],  # what -> value, in the order of the table
    warnings: Series[str],
    figures: Series[tuple[str, bytes]],  # (caption, PNG)
) -> str:
    """Return the HTML of a report: summary table, warnings, then the figures in order."""
    rows = "\n".join(
        f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>"
        for name, value in summary.items()
    )
    notes = "\n".join(f'<p class="warning">{escape(warning)}</p>' for warning in warnings)
    pictures = "\n".join(_figure(caption, png) for caption, png in figures)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>
{_STYLE}
</style>
</head>
<body>
<h1>{escape(title)}</h1>
{notes}
<table>
{rows}
</table>
{pictures}
</body>
</html>
"""


def _figure(caption: str, png: bytes) -> str:
    data = base64.b64encode(png).decode("ascii")
    alternative = escape(caption, quote=True)
    return (
        f'<figure><img src="data:image/png;base64,{data}" alt="{alternative}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )
