"""Files in and out: sequences to read, trajectories, maps and run folders to write."""

from minislam.data.options import InputOptions
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.data.trajectory import read_trajectory, write_trajectory

__all__ = [
    "InputOptions",
    "RecordedSequence",
    "open_sequence",
    "read_trajectory",
    "write_trajectory",
]
