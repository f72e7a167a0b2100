"""The mapper: it decides which Gaussians are inserted and removed, and when they are optimised.

Read `initialise`, `integrate` and `refine` first: they are the three moments at which the map is
built. An image of the map is a keyframe of the tracker or, at the end, a frame between two.
"""

import math
from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from minislam.mapping import insertion, safeguards
from minislam.mapping.deformation import deform_rigidly
from minislam.mapping.gaps import filled_depth, is_refuted
from minislam.mapping.optimisation import JointOptimisation
from minislam.mapping.pose_refinement import refine_pose
from minislam.mapping.views import median_depth, view_gradients
from minislam.mapping.window import sampling_probabilities, update_window
from minislam.records import MapImage, Progress
from minislam.splatting import Rendering
from minislam.state.memory import release
from minislam.uncertainty import RenderingError
from minislam.uncertainty.losses import FAR_FACTOR

MOST_FAR = 0.99  # of the largest depth that is inserted: farther gaps, and the sky, get this [-]
VISIBLE = 0.5  # px: a view sees the Gaussians whose blending weights in it sum to more than this


class Mapper(JointOptimisation):
    """Grow the map of the static scene keyframe by keyframe, and train the MLP on the way."""

    def initialise(
        self, images: list[MapImage], progress: Progress | None = None, online: bool = False
    ) -> None:
        """Begin a map, online with the first keyframes, else with all images; train the MLP."""
        assert images, "a map starts from at least one image"
        self.median_depth = median_depth(images)
        self.images = list(images)
        if self.config.mean_background:
            means = []
            for image in images:
                means.append(image.levelled.mean((0, 1)))
                release()
            self.background = torch.stack(means).mean(0)
        count = len(images)
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

    def integrate(self, keyframe: MapImage) -> None:
        """Add one keyframe: window, removal on dynamic objects, insertion, then optimisation."""
        assert self.images, "call initialise first"
        self.images.append(keyframe)
        new = len(self.images) - 1
        poses = torch.stack([image.T_camera_world for image in self.images])
        camera, among = self._online_camera, [new, *self.window]
        seen = {k: self.render(poses[k], camera).weight_sums > VISIBLE for k in among}
        self.window = update_window(self.window, new, seen, poses, self.config.window_size)
        self._remove_dynamic_gaussians(self.window)
        self._insert(new)
        if new % self.config.keyframe_stride != 0:
            return  # Fast mode: this keyframe waits for the next optimisation.
        of_window = self.config.window_probability
        probabilities = sampling_probabilities(len(self.images), self.window, of_window)
        self._optimise([self._online_camera] * self.config.keyframe_iterations, probabilities)

    def update_poses(self, T_camera_world: Tensor) -> None:
        """Take over corrected poses (K, 4, 4) of all images: Gaussians move with their anchors."""
        assert len(T_camera_world) == len(self.images), len(T_camera_world)
        old = torch.stack([image.T_camera_world for image in self.images])
        new, anchors = T_camera_world.double(), self.gaussians.anchor_keyframe
        # Adam's moments are kept, because a bundle adjustment moves the map by little.
        self._optimizer.replace(deform_rigidly(self.gaussians, anchors, old, new))
        rows = zip(self.images, new, strict=True)
        self.images = [replace(image, T_camera_world=pose) for image, pose in rows]

    def refine(self, iterations: int, progress: Progress | None = None, done: int = 0) -> None:
        """Optimise map and MLP over all images of the map, the last part at full image size.

        Half way, if each had two renderings, the upper mode of beta is excluded, gaps are filled;
        at the end, Gaussians that no static pixel shows go. A resumed run goes on after `done`.
        """
        full = round(iterations * self.config.refine_full_fraction)
        cameras = [self._online_camera] * (iterations - full) + [self.camera] * full
        schedule = cameras, None, progress, self.config.refine_rate_end
        half = iterations // 2 // self.config.views_per_step * self.config.views_per_step
        if done <= half:
            self._optimise(*schedule, range(done, half))
            if half >= safeguards.LEAST_VIEWS * len(self.images):
                self._exclude_upper_mode()
                for position in range(len(self.images)):
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
        """Add Gaussians for what an image shows and the map does not."""
        image, config = self.images[position], self.config.insertion
        if not image.inserts:
            return
        colors, depth, pose = image.levelled, image.depth, image.T_camera_world
        rendering = self.render(pose) if len(self.gaussians) else None
        if fills and rendering is not None:
            known = torch.where(depth > 0, depth, surface_depth(rendering))
            depth = filled_depth(known).clamp_max(MOST_FAR * FAR_FACTOR * self.median_depth)
        weight = self.static_weight(self.beta_of(image), self.camera)
        far_limit = FAR_FACTOR * self.median_depth
        allowed = insertion.insertable_pixels(depth, far_limit, weight, rendering)
        sides = insertion.cell_sides(colors, depth, self.cell, config.plain)
        pixels = insertion.draw_pixels(depth > 0, sides, self._generator)
        pixels = pixels[allowed[pixels[:, 1], pixels[:, 0]]]
        view = colors, depth, self.camera, pose
        new = insertion.gaussians_at_pixels(pixels, sides, *view, position, config)
        if fills:
            new = new.keep(~is_refuted(new.means, new.colors, self.camera, image, self.images))
        self._optimizer.append(new)
        self._reset_gradients()

    def _remove_dynamic_gaussians(self, positions: Iterable[int]) -> None:
        """Remove Gaussians that images inserted on an object before the MLP knew it moves."""
        gaussians, camera = self.gaussians, self._online_camera
        stays = torch.ones_like(gaussians.anchor_keyframe, dtype=torch.bool)
        for position in positions:
            image, anchored = self.images[position], gaussians.anchor_keyframe == position
            view = camera, image.T_camera_world, self.static_weight(self.beta_of(image), camera)
            stays[anchored] = ~insertion.is_on_dynamic_object(gaussians.means[anchored], *view)
        self._optimizer.keep(stays)
        self._reset_gradients()

    def _exclude_upper_mode(self) -> None:
        """Exclude the upper mode of beta in images with confirmation, if the map is wrong there."""
        swept = [image for image in self.images if image.confirmation is not None]
        if not swept or not self.uncertainty.is_learned:
            return
        beta = torch.stack([self.learned_beta(image) for image in swept])
        least = safeguards.least_weight(beta.flatten())
        if least <= self.least_weight:
            return
        asked = slice(None, None, math.ceil(len(swept) / safeguards.ASKED))
        calls = (self._view_arguments(i, self._online_camera, trains=True) for i in swept[asked])
        views = self._workers.stream(view_gradients, calls)
        error = RenderingError.stacked(view.error for view in views)
        beta = beta[asked]
        if safeguards.is_wrong(error, beta, least, self.uncertainty):
            self.least_weight = least
            self._replace_dynamic_gaussians()

    def _remove_unsupported(self) -> None:
        """Remove Gaussians that hardly any static pixel shows, and note what is shown.

        Some lie on a dynamic object that always covers the view: they had no gradient since the MLP
        learned it. Others have left all views, and would be floaters in new ones.
        """
        camera, gaussians, self.shown = self._online_camera, self.gaussians, []
        weights = (self.static_weight(self.beta_of(image), camera) for image in self.images)
        views = zip(self.images, weights, strict=True)
        calls = ((gaussians, camera, image.T_camera_world, weight) for image, weight in views)
        sums = gaussians.means.new_zeros(2, len(gaussians))
        for of_view, fraction in self._workers.stream(safeguards.static_blending, calls):
            sums += of_view
            self.shown.append(fraction)
        static, total = sums
        if static.any() and self.uncertainty.enabled:  # else all stay
            self._optimizer.keep(static > safeguards.LEAST_STATIC * total)
            self._reset_gradients()

    def _replace_dynamic_gaussians(self) -> None:
        """Remove Gaussians on dynamic objects; let images fill the holes that they see."""
        self._remove_dynamic_gaussians(range(len(self.images)))
        for position in range(len(self.images)):
            self._insert(position)


def surface_depth(rendering: Rendering) -> Tensor:  # (H, W)
    """Return the depth of the visible surface [world units], 0 where the map is transparent."""
    depth = rendering.depth / rendering.opacity.clamp_min(safeguards.OPAQUE)
    return torch.where(rendering.opacity > safeguards.OPAQUE, depth, 0)
