"""Multi-view stereo: dense depth from posed frames, without any network.

Not a part of the paper, which takes its depth from a network alone. Read the files in this order:
sweep, aggregation, votes, dense_structure, second_adjustment.
"""
