"""What pyproject.toml cannot say: notebooks go into the package, README's links to the repository.

The notebooks stay where a reader of the repository looks for them. A package index shows README
without the repository around it; with an address `Repository` below `[project.urls]` of
pyproject.toml, README's relative links lead there.
"""

import re
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parent


class BuildWithNotebooks(build_py):
    """Copy notebooks/ and the licence to minislam/notebooks/ in a wheel.

    An editable install finds notebooks/ in the repository.
    """

    def run(self) -> None:
        """Build the package, then add the notebooks."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "minislam" / "notebooks"
            notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
            text = b"".join(path.read_bytes() for path in notebooks)
            for path in [
                *notebooks,
                *(ROOT / "notebooks").glob("*.md"),
                *ROOT.glob("notebooks/*/*.*"),
            ]:
                name = path.relative_to(ROOT / "notebooks")
                if path.parent.name == "notebooks" or name.as_posix().encode() in text:
                    self.mkpath(str((target / name).parent))
                    self.copy_file(str(path), str(target / name))
            self.copy_file(str(ROOT / "LICENSE"), str(target / "LICENSE"))


def readme() -> str:
    """Return README as a package index shows it."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    address = project.get("urls", {}).get("Repository", "").rstrip("/")
    if not address:
        return text
    return re.sub(r"\]\((?![a-z]+:|#)([^)]+)\)", rf"]({address}/raw/main/\1)", text)


setup(
    cmdclass={"build_py": BuildWithNotebooks},
    long_description=readme(),
    long_description_content_type="text/markdown",
)
