"""The state of a run: parts that can be saved (stateful.py), steps.py, memory.py, threads.py."""
