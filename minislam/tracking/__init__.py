"""Tracking (paper Sec. 3.3): poses and disparities of keyframes from optical flow.

Reading order:

    grid                the cells of the image on which everything is measured
    reprojection        where a cell of one keyframe is seen in another, with derivatives
    bundle_problem      the constants of a bundle adjustment, and its unknowns
    bundle_adjustment   dense bundle adjustment, Eq. (5); reference.py is its slow twin
    schur               its normal equations, with the disparities marginalised
    disparity_prior     the mask M of the disparity prior, Eq. (8)
    keyframes           the store: pose, disparities, prior and weights of each keyframe
    frame_graph         the edges between keyframes and the flow along them; the flow distance
    pose_from_flow      pose and disparities of a new image
    keyframe_graph      keyframes and edges together: matching, covisibility
    optimisation        local BA, online global BA, final global BA
    initialisation      the first geometry, from flow alone
    keyframe_selection  which frames become keyframes
    loop_closure        global BA when the camera is back at a place
    tracker             the whole: one frame after the other, from warm-up to final BA
    trajectory          poses of the frames between the keyframes
    safeguards/         what real footage needs and the paper does not have
    config              the settings
"""
