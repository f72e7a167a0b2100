"""What is known of an image before any geometry: optical flow, features, depth.

Read in this order: `interfaces.py` says what the system asks for. Flow: `dense_flow.py` (DIS,
warp, compose), `grid_flow.py` (matches and confidence at the grid cells), `flow.py` (the
`FlowEstimator`). Features: `features.py`. Depth: `depth.py`. `files.py` reads features and depth
that were made elsewhere; `networks/` holds the pretrained networks; `choice.py` chooses among all
of them by the names on the command line (`names.py`), and `conformance.py` checks those of others.
"""
