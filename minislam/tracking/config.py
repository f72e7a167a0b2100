"""Settings of the tracker."""

from dataclasses import dataclass, field, replace

from minislam.parameters import parameter


@dataclass(frozen=True)
class LearnedFlowConfig:
    """What a learned flow takes instead: its own defaults, and what preset `paper` sets for it.

    Flow and geometry take turns: one update of the flow, two Gauss-Newton steps, and again. Whoever
    sets tracking.X sets tracking.learned.X as well, unless both are given (`with_settings`).
    """

    keyframe_flow: float = parameter(10.0, "as tracking.keyframe_flow [px]")
    keyframe_flow_without_prior: float = parameter(18.0, "without prior, or in the start [px]")
    warmup_rounds: int = parameter(4, "rounds of flow and BA before beta is known", 1)
    warmup_rounds_with_beta: int = parameter(2, "rounds once beta is known")
    warmup_iterations: int = parameter(2, "Gauss-Newton steps per round of the warm-up", 1)
    window: int = parameter(10, "newest keyframes that the local BA moves", 1)
    rounds: int = parameter(4, "rounds per keyframe", 1)
    active_edges: int = parameter(
        0, "edges of a round: the newest keyframe's, filled up with old ones to this many"
    )
    iterations: int = parameter(2, "Gauss-Newton steps per round", 1)
    global_iterations: int = parameter(2, "Gauss-Newton steps per round of a global BA", 1)
    robust_scale: float = parameter(0.0, "as tracking.robust_scale: none is needed [px]")
    motion_memory: float = parameter(0.0, "as tracking.motion_memory: none is needed [px]")
    lambda_disparity_prior: float = parameter(0.02, "lambda_4, near the official code's [-]")
    final_rounds: int = parameter(4, "rounds of the final global BA")
    pose_rounds: int = parameter(6, "rounds per frame between keyframes, or before it is linked", 1)
    pose_iterations: int = parameter(2, "Gauss-Newton steps per round of such a frame", 1)


@dataclass(frozen=True)
class TrackingConfig:
    """Settings of the tracker. Lengths in px hold for 320x240 and grow with the image diagonal."""

    keyframe_flow: float = parameter(10.0, "mean flow since the last keyframe that makes one [px]")
    keyframe_flow_without_prior: float = parameter(18.0, "without prior, and in the start [px]")
    keyframe_interval: int = parameter(8, "most frames to the next keyframe, paper supplement", 1)
    warmup_keyframes: int = parameter(6, "keyframes of the start; the paper takes 12", 2)
    warmup_rounds: int = parameter(3, "rounds of flow and BA before beta is known", 1)
    warmup_rounds_with_beta: int = parameter(2, "rounds of flow and BA once beta is known")
    warmup_iterations: int = parameter(6, "Gauss-Newton steps per round of the warm-up", 1)
    window: int = parameter(10, "newest keyframes that the local BA moves", 1)
    active_edges: int = parameter(0, "edges measured per keyframe, old ones included; 0: its own")
    rounds: int = parameter(2, "rounds of flow and BA per keyframe", 1)
    iterations: int = parameter(3, "Gauss-Newton steps per round", 1)
    global_iterations: int = parameter(4, "Gauss-Newton steps per round of a global BA", 1)
    # Matching is no more precise in a smaller image, so there c does not shrink.
    robust_scale: float = parameter(1.0, "c: width of the robust weight [px]; 0: least squares")
    robust_power: float = parameter(2.0, "k of (1 + r^2/c^2)^-k; 1: Cauchy, 2: Geman-McClure [-]")
    motion_memory: float = parameter(
        3.0, "residual that lowers a cell's motion weight, handed on along the flow [px]; 0: off"
    )
    # Times fx^2, so a disparity error weighs as the pixels that a unit baseline turns it into.
    lambda_disparity_prior: float = parameter(
        0.0, "lambda_4: disparity prior, times fx^2; 0: it is a start and the unit [-], Eq. (5)"
    )
    prior_mask: bool = parameter(True, "mask M: no prior that other views contradict, Eq. (8)")
    mask_max_depth_error: float = parameter(
        0.02, "epsilon: relative difference of depths that still agree [-], Eq. (8)"
    )
    mask_min_similarity: float = parameter(
        0.9, "gamma: cosine of features that show the same thing [-], Eq. (8)", most=1
    )
    mask_min_corresponding: int = parameter(2, "views that must see a cell, paper supplement")
    mask_min_consistent: int = parameter(2, "of which this many must agree, official code")
    global_interval: int = parameter(20, "fewest keyframes between global BAs, official; 0: none")
    loop_closure: bool = parameter(True, "link a new keyframe with places seen long ago")
    loop_min_gap: int = parameter(20, "least gap between a loop's ends [keyframes]; official 21", 1)
    loop_distance: float = parameter(120.0, "largest flow distance of a loop [px]")
    loop_edges: int = parameter(2, "loops of one keyframe, nearest by flow distance")
    rolling_shutter: bool = parameter(True, "estimate how long the camera takes to read an image")
    final_rounds: int = parameter(2, "rounds of the final global BA; official 7 + 12")
    final_prior: bool = parameter(False, "keep the disparity prior in the final BA (an ablation)")
    pose_rounds: int = parameter(1, "rounds of flow and pose per frame between keyframes", 1)
    pose_iterations: int = parameter(8, "Gauss-Newton steps per round of such a frame", 1)
    learned: LearnedFlowConfig = field(default_factory=LearnedFlowConfig)

    def for_learned_flow(self) -> "TrackingConfig":
        """Return the settings for a flow whose confidence is learned."""
        return replace(self, **vars(self.learned))
