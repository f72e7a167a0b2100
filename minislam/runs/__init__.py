"""One run, from a sequence to a folder of results (files: see the end of `minislam run --help`).

api.py is the Python interface; run.py does a run from its start to its folder; facts.py says what
run.json and metrics.json hold; pictures.py draws; resume.py saves checkpoints and restores them.
"""
