"""The commands, one file each: `demo`, `run`, `priors`, `weights`, `eval`, `doctor`."""
