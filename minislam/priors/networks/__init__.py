"""The pretrained networks of the paper, as short functions over their official checkpoints."""
