"""The commands: `minislam demo | run | priors | eval | doctor`, one file each; `main.py` first."""
