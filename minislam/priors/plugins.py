"""Priors made elsewhere: in a Python module, or in an installed package.

`--depth python:MODULE:FACTORY` imports MODULE, also from the current folder, and calls
FACTORY(device), or FACTORY(device, FILE) with `--depth-weights FILE`. An installed package gives
its factory a name of its own by an entry point in the group `minislam.depth`. The same holds for
features and flow.
"""

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from minislam.errors import InputError
from minislam.priors import conformance
from minislam.priors.names import PYTHON

_CHECKS = {
    "flow": conformance.check_flow_estimator,
    "features": conformance.check_feature_extractor,
    "depth": conformance.check_depth_prior,
}


def load_plugin(kind: str, name: str, device: str, weights: str | None) -> Any | None:
    """Return the prior of a flag --KIND NAME, checked; None if no package has this name."""
    group = f"minislam.{kind}"
    found = list(entry_points(group=group, name=name))
    if name.startswith(PYTHON):
        if "" not in sys.path:
            sys.path.append("")  # the current folder, which `minislam` alone does not look into
        found = [EntryPoint(name, name.removeprefix(PYTHON), group)]
    if not found:
        return None
    try:
        make = found[0].load()
        prior = make(device) if weights is None else make(device, weights)
    except (Exception, SystemExit) as error:
        raise InputError(
            f"expected --{kind} {name} to name a function that makes a prior of a device, found "
            f"{type(error).__name__}: {str(error).partition(chr(10))[0]}; write it like "
            f"{PYTHON}MODULE:FUNCTION, see minislam/priors/networks/README.md"
        ) from error
    _CHECKS[kind](prior, f"--{kind} {name}")
    return prior
