"""Multi-view stereo: dense depth from posed frames, without any network.

Not a part of the paper, which takes its depth from a network alone. Read the files in this order:

    sweep              how well each pixel matches other images at each depth
    aggregation        depths of neighbouring pixels fit together
    votes              geometric consistency: other views confirm depths of the static scene
    dense_structure    which frames are swept, and against which others
    second_adjustment  the final adjustment again, on what is confirmed
"""
