"""WildGS-SLAM in plain Python: monocular Gaussian-splatting SLAM for scenes with moving objects.

Begin with `Slam.run` in slam.py, the whole system on one screen.
"""

__version__ = "0.1.0"
