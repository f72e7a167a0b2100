"""What real footage needs and the paper does not have.

robust           the robust weight inside Sigma, for a flow without a learned confidence
parts            restricts a bundle problem to some edges, keyframes or cells
motion_memory    remembers which cells have moved, so that a growing dynamic object stays excluded
settling         which disparities parallax has measured: only these warp to a new keyframe
relocalisation   finds a lost camera among the keyframes
revisits         finds a loop that drift hides from the geometry, by its appearance
pose_support     tries other starts for poses between keyframes that little of the flow supports
first_frame      chooses the start: not a black frame, a slate, or the shorter side of a cut
first_camera     which minimum the start takes, with an unknown focal length and readout
diagnostics      how well each keyframe is tied to the others
pieces           which stretches of a broken trajectory belong together
depth_agreement  whether other views measure the same depths
turns            recognises a camera that stands or only rotates, and adjusts rotations alone
focal_length     estimates an unknown focal length and the readout, checks a given focal length
focal_column     the focal length as one more unknown of the bundle adjustment
lens             estimates a radial distortion that no calibration gives
scale_certainty  how precisely the flow measures the scale, by the covariance of the poses
scale_drift      undoes a drift of the scale that a depth prior reveals
exposure         how bright each keyframe is, from the matches along the edges
rolling_shutter  the time to read an image, as unknowns too; images as a global shutter sees them
"""
