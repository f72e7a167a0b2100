"""The pretrained networks of the paper, as short functions over their official checkpoints.

Read in this order: `checkpoints.py` (files and layers), `table.py` (which networks there are, and
how to add one), `vit.py` (the transformer of DINOv2, and its features), the depth networks
`depth_anything.py` and `metric3d.py`, then `droid_network.py` (the network of DROID-SLAM) and
`droid.py` (its flow estimator). Where to get the checkpoints: `README.md`.
"""
