"""The state of a run: its memory (memory.py), its parts (stateful.py), its steps (steps.py)."""
