"""One run, from a sequence to a folder of results (files: see the end of `minislam run --help`).

Read the files in this order:

    api         the Python interface: run, load
    run         a run from its start to its folder
    resume      when checkpoints are saved, and which run may go on from one
    progress    the line that a run shows, and how a signal ends the run between two steps
    facts       what run.json holds
    warnings    what the user must know
    measures    what metrics.json holds
    summary     the measures in words; measures.csv has their bounds
    pictures    images, plots, report and viewer
    loaded      `Run`, a run read back: to render, plot and export it
    flythrough  films of a run
    export      COLMAP, nerfstudio, point clouds, depth and masks
"""
