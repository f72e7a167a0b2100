"""The pretrained networks of the paper, as short functions over their official checkpoints.

Read in this order: checkpoints, table (which networks there are, and how to add one), vit,
depth_anything, metric3d, droid_network, droid. Where to get the checkpoints: `README.md`.
"""
