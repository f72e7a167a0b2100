"""The mapper: it decides which Gaussians are inserted and removed, and when they are optimised.

Read `initialise`, `integrate` and `refine` first: they are the three moments at which the map is
built. `update_keyframes` moves it when the tracker has corrected poses.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from minislam.mapping import safeguards
from minislam.mapping.deformation import deform_rigidly
from minislam.mapping.gaps import filled_depth, is_refuted
from minislam.mapping.insertion import (
    cell_sides,
    draw_pixels,
    gaussians_at_pixels,
    insertable_pixels,
    is_on_dynamic_object,
)
from minislam.mapping.optimisation import JointOptimisation
from minislam.mapping.pose_refinement import refine_pose
from minislam.mapping.views import median_depth, view_gradients
from minislam.mapping.window import sampling_probabilities, update_window
from minislam.records import Keyframe, Progress
from minislam.splatting import Rendering
from minislam.state.memory import release
from minislam.uncertainty import RenderingError
from minislam.uncertainty.losses import FAR_FACTOR

MOST_FAR = 0.99  # of the largest depth that is inserted: what fills a gap lies no farther [-]
VISIBLE = 0.5  # px: a view sees the Gaussians whose blending weights in it sum to more than this


class Mapper(JointOptimisation):
    """Grow the map of the static scene keyframe by keyframe, and train the MLP on the way."""

    def initialise(
        self,
        keyframes: list[Keyframe],
        progress: Progress | None = None,
        online: bool = False,  # more keyframes will come
    ) -> None:
        """Begin a map with keyframes, online the first, at the end all; train the MLP on it."""
        assert keyframes, "a map starts from at least one keyframe"
        self.median_depth = median_depth(keyframes)
        self.keyframes = list(keyframes)
        if self.config.mean_background:
            means = []
            for keyframe in self.keyframes:
                means.append(keyframe.levelled.mean((0, 1)))
                release()
            self.background = torch.stack(means).mean(0)
        count = len(self.keyframes)
        if self.uncertainty.is_learned:
            self._weighted_from = safeguards.FIRST_VIEWS * count
        for position in range(count):
            self._insert(position)
        self.window = list(range(count - 1, -1, -1))[: self.config.window_size]
        iterations = self.config.init_iterations
        if online:
            iterations = min(iterations, count * self.config.keyframe_iterations)
        iterations = max(iterations, self._weighted_from)
        self._optimise([self._online_camera] * iterations, progress=progress)
        self._replace_dynamic_gaussians()

    def integrate(self, keyframe: Keyframe) -> None:
        """Add one keyframe: window, removal on dynamic objects, insertion, then optimisation."""
        assert self.keyframes, "call initialise first"
        self.keyframes.append(keyframe)
        new = len(self.keyframes) - 1
        poses = torch.stack([k.T_camera_world for k in self.keyframes])
        camera, among = self._online_camera, [new, *self.window]
        seen = {k: self.render(poses[k], camera).weight_sums > VISIBLE for k in among}
        self.window = update_window(self.window, new, seen, poses, self.config.window_size)
        self._remove_dynamic_gaussians(self.window)
        self._insert(new)
        if new % self.config.keyframe_stride != 0:
            return  # Fast mode: this keyframe waits for the next optimisation.
        of_window = self.config.window_probability
        probabilities = sampling_probabilities(len(self.keyframes), self.window, of_window)
        self._optimise([self._online_camera] * self.config.keyframe_iterations, probabilities)

    def update_keyframes(self, T_camera_world: Tensor) -> None:
        """Take over new poses (K, 4, 4) of all keyframes: Gaussians move with their anchors.

        Adam's moments are kept, because a bundle adjustment moves the map by little.
        """
        assert len(T_camera_world) == len(self.keyframes), len(T_camera_world)
        old = torch.stack([keyframe.T_camera_world for keyframe in self.keyframes])
        new = T_camera_world.double()
        anchors = self.gaussians.anchor_keyframe
        self._optimizer.replace(deform_rigidly(self.gaussians, anchors, old, new))
        rows = zip(self.keyframes, new, strict=True)
        self.keyframes = [replace(keyframe, T_camera_world=pose) for keyframe, pose in rows]

    def refine(self, iterations: int, progress: Progress | None = None, done: int = 0) -> None:
        """Optimise map and MLP over all images of the map, the last part at full image size.

        Half way, if each had two renderings, the upper mode of beta is excluded and gaps are
        filled; at the end, Gaussians that no static pixel shows are removed. A resumed run goes on
        after what is done.
        """
        full = round(iterations * self.config.refine_full_fraction)
        cameras = [self._online_camera] * (iterations - full) + [self.camera] * full
        schedule = cameras, None, progress, self.config.refine_rate_end
        half = iterations // 2 // self.config.views_per_step * self.config.views_per_step
        if done <= half:
            self._optimise(*schedule, range(done, half))
            if half >= safeguards.LEAST_VIEWS * len(self.keyframes):
                self._exclude_upper_mode()
                for position in range(len(self.keyframes)):
                    self._insert(position, fills=True)  # with the depth of the surroundings
        self._optimise(*schedule, range(max(done, half), iterations))
        self._remove_unsupported()

    def refine_poses(
        self,
        T_camera_world: list[Tensor],  # (4, 4) float64 each, of frames that are no keyframes
        images: list[Tensor],  # (H, W, 3) RGB in [0, 1]
        betas: list[Tensor],  # (h', w')
    ) -> list[Tensor]:  # (4, 4) float64
        """Return the poses near the given ones whose renderings are most like the images."""
        weights = [self.static_weight(beta, self.camera) for beta in betas]
        fixed = self.background, self.config.pose_refinement
        views = zip(T_camera_world, images, weights, strict=True)
        calls = [(self.gaussians, self.camera, *view, *fixed) for view in views]
        return self._workers.map(refine_pose, calls)

    @torch.no_grad()
    def _insert(self, position: int, fills: bool = False) -> None:
        """Add Gaussians for what a keyframe sees and the map does not show."""
        keyframe = self.keyframes[position]
        if not keyframe.inserts:
            return
        rendering = self.render(keyframe.T_camera_world) if len(self.gaussians) else None
        if fills and rendering is not None:
            known = torch.where(keyframe.depth > 0, keyframe.depth, surface_depth(rendering))
            farthest = MOST_FAR * FAR_FACTOR * self.median_depth
            keyframe = replace(keyframe, depth=filled_depth(known).clamp_max(farthest))
        weight = self.static_weight(self.beta_of(keyframe), self.camera)
        far_limit = FAR_FACTOR * self.median_depth
        allowed = insertable_pixels(keyframe.depth, far_limit, weight, rendering)
        insertion, image, depth = self.config.insertion, keyframe.levelled, keyframe.depth
        sides = cell_sides(image, depth, self.cell, insertion.plain)
        pixels = draw_pixels(depth > 0, sides, self._generator)
        pixels = pixels[allowed[pixels[:, 1], pixels[:, 0]]]
        view = image, depth, self.camera, keyframe.T_camera_world
        new = gaussians_at_pixels(pixels, sides, *view, position, insertion)
        if fills:
            views = self.camera, self.keyframes[position], self.keyframes
            new = new.prune(~is_refuted(new.means, new.colors, *views))
        self._optimizer.append(new)
        self._reset_gradients()

    def _remove_dynamic_gaussians(self, positions: Iterable[int]) -> None:
        """Remove Gaussians that keyframes inserted on an object before the MLP knew it moves."""
        gaussians = self.gaussians
        keep = torch.ones_like(gaussians.anchor_keyframe, dtype=torch.bool)
        for position in positions:
            keyframe = self.keyframes[position]
            anchored = (gaussians.anchor_keyframe == position).nonzero().squeeze(-1)
            weight = self.static_weight(self.beta_of(keyframe), self._online_camera)
            view = self._online_camera, keyframe.T_camera_world, weight
            keep[anchored] = ~is_on_dynamic_object(gaussians.means[anchored], *view)
        self._optimizer.prune(keep)
        self._reset_gradients()

    def _exclude_upper_mode(self) -> None:
        """Exclude the upper mode of beta in images with confirmation, if the map is wrong there."""
        swept = [keyframe for keyframe in self.keyframes if keyframe.confirmation is not None]
        if not swept or not self.uncertainty.is_learned:
            return
        least = safeguards.least_weight(torch.cat([self.beta_of(k).flatten() for k in swept]))
        if least <= self.least_weight:
            return
        sample = swept[:: math.ceil(len(swept) / safeguards.ASKED)]
        calls = (self._view_arguments(k, self._online_camera, trains=True) for k in sample)
        errors = [vars(v.error).values() for v in self._workers.stream(view_gradients, calls)]
        error = RenderingError(*map(torch.stack, zip(*errors, strict=True)))
        beta = torch.stack([self.beta_of(keyframe) for keyframe in sample])
        if safeguards.is_wrong(error, beta, least, self.uncertainty):
            self.least_weight = least
            self._replace_dynamic_gaussians()

    def _remove_unsupported(self) -> None:
        """Remove Gaussians that hardly any static pixel shows, and note what is shown.

        Some were inserted on a dynamic object before the MLP had learned it, and where it always
        covers the view they have had no gradient since. Others have moved out of all views, and
        would be floaters in new ones. Where nothing is static, all stay.
        """
        camera, gaussians, self.shown = self._online_camera, self.gaussians, []
        weights = (self.static_weight(self.beta_of(k), camera) for k in self.keyframes)
        views = zip(self.keyframes, weights, strict=True)
        calls = ((gaussians, camera, k.T_camera_world, weight) for k, weight in views)
        sums = gaussians.means.new_zeros(2, len(gaussians))
        for of_view, fraction in self._workers.stream(safeguards.static_blending, calls):
            sums += of_view
            self.shown.append(fraction)
        static, total = sums
        if static.any() and self.uncertainty.enabled:
            self._optimizer.prune(static > safeguards.LEAST_STATIC * total)
            self._reset_gradients()

    def _replace_dynamic_gaussians(self) -> None:
        """Remove Gaussians on dynamic objects; let keyframes fill the holes that they see."""
        self._remove_dynamic_gaussians(range(len(self.keyframes)))
        for position in range(len(self.keyframes)):
            self._insert(position)


def surface_depth(rendering: Rendering) -> Tensor:  # (H, W)
    """Return the depth of the visible surface [world units], 0 where the map is transparent."""
    depth = rendering.depth / rendering.opacity.clamp_min(safeguards.OPAQUE)
    return torch.where(rendering.opacity > safeguards.OPAQUE, depth, 0)
