"""Read sequences; read and write trajectories, maps and run folders."""

from minislam.data.files import atomic_write
from minislam.data.options import InputOptions
from minislam.data.ply import GaussianArrays, read_ply, write_ply
from minislam.data.run_folder import RunFolder
from minislam.data.sequence import RecordedSequence, open_sequence
from minislam.data.trajectory import read_trajectory, write_trajectory

__all__ = [
    "GaussianArrays",
    "InputOptions",
    "RecordedSequence",
    "RunFolder",
    "atomic_write",
    "open_sequence",
    "read_ply",
    "read_trajectory",
    "write_ply",
    "write_trajectory",
]
