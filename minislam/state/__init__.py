"""A resumed run needs the state of its parts (stateful.py) and its finished steps (steps.py)."""
