"""minislam: monocular Gaussian-splatting SLAM for scenes with moving objects (WildGS-SLAM)."""

__version__ = "0.1.0"
