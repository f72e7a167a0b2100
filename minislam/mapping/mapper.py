"""The mapper: it owns the Gaussian map, the keyframes and the uncertainty MLP."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from minislam.errors import InputError
from minislam.geometry import Camera
from minislam.mapping.config import MappingConfig
from minislam.mapping.deformation import deform_rigidly, rescale_to_depths
from minislam.mapping.density import ScreenGradients, densify, useful_rows
from minislam.mapping.history import MappingHistory
from minislam.mapping.insertion import (
    draw_pixels,
    gaussians_at_pixels,
    insertable_pixels,
    lies_on_mover,
)
from minislam.mapping.losses import render_loss
from minislam.mapping.pose_refinement import refine_pose
from minislam.mapping.views import MappedKeyframe, keyframe_misfit, median_depth
from minislam.mapping.window import sampling_probabilities, update_window
from minislam.records import Keyframe
from minislam.splatting import GaussianMap, MapOptimizer, Rendering, render
from minislam.state.stateful import Stateful
from minislam.uncertainty import (
    UncertaintyConfig,
    UncertaintyMLP,
    UncertaintyTrainer,
    mapping_weight,
)

Progress = Callable[[int, int], None]  # called with the iterations done and their number


class Mapper(Stateful):
    """Grow and optimise the map of the static scene, and train the MLP on what does not fit."""

    keyframes: list[MappedKeyframe]
    window: list[int]  # positions in `keyframes`, newest first
    median_depth: float = 1.0  # world units; set by the first keyframes, then fixed
    background: Tensor  # RGB of what no keyframe sees
    history: MappingHistory
    _trainer: UncertaintyTrainer
    _generator: torch.Generator
    _optimizer: MapOptimizer
    _gradients: ScreenGradients
    _iteration: int = 0
    _frozen_until: int = 0  # iteration from which on the MLP learns again

    def __init__(
        self,
        camera: Camera,  # of the keyframe images
        config: MappingConfig,
        uncertainty: UncertaintyConfig,
        feature_dimension: int,  # C
        seed: int,
        device: torch.device | str = "cpu",  # where the keyframes' tensors live
    ) -> None:
        self.camera = camera
        self.config = config
        self.uncertainty = uncertainty
        self.keyframes = []
        self.window = []
        self.background = torch.zeros(3, device=device)
        self.history = MappingHistory()
        self._trainer = UncertaintyTrainer(feature_dimension, uncertainty, seed, device)
        self._generator = torch.Generator().manual_seed(seed + 1)
        self._optimizer = MapOptimizer(GaussianMap.empty(device=device), config.rates)
        self._gradients = ScreenGradients(0)
        sides = (camera.width, camera.height)
        online = [max(1, round(config.image_scale * side)) for side in sides]
        self._online_camera = camera.resized(*online)

    @property
    def gaussians(self) -> GaussianMap:
        """Return the map, without gradients."""
        return self._optimizer.gaussians.detach()

    @property
    def mlp(self) -> UncertaintyMLP:
        """Return the uncertainty MLP."""
        return self._trainer.mlp

    def predict_beta(self, features: Tensor) -> Tensor:
        """Return the raw beta (h', w') of features (h', w', C)."""
        return self._trainer.predict(features)

    @torch.no_grad()
    def render(self, T_camera_world: Tensor, camera: Camera | None = None) -> Rendering:
        """Render the map from a pose (4, 4), without gradients."""
        camera = camera or self.camera
        return render(self.gaussians, camera, T_camera_world.float(), self.background)

    def initialise(self, keyframes: list[Keyframe], progress: Progress | None = None) -> None:
        """Build the map of the first keyframes and train the MLP on it (two-stage start)."""
        if not keyframes:
            raise InputError("expected at least one keyframe to start the map from, found none")
        self.median_depth = median_depth(keyframes)
        if self.config.mean_background:
            self.background = torch.stack([k.image.mean((0, 1)) for k in keyframes]).mean(0)
        for keyframe in keyframes:
            self.keyframes.append(MappedKeyframe.from_record(keyframe))
            self._insert(len(self.keyframes) - 1)
        count = len(self.keyframes)
        self.window = list(range(count - 1, -1, -1))[: self.config.window_size]
        uniform = torch.full((count,), 1 / count, dtype=torch.float64)
        self._optimise([self._online_camera] * self.config.init_iterations, uniform, progress)
        self._exchange_movers()

    def integrate(self, keyframe: Keyframe, progress: Progress | None = None) -> None:
        """Add one keyframe: window, insertion, then optimisation of map and MLP."""
        if not self.keyframes:
            raise InputError("expected an initialised map, found none; call initialise first")
        self.keyframes.append(MappedKeyframe.from_record(keyframe))
        new = len(self.keyframes) - 1
        seen = {position: self._seen(position) for position in [new, *self.window]}
        poses = torch.stack([k.T_camera_world for k in self.keyframes])
        size, overlap = self.config.window_size, self.config.window_overlap
        self.window = update_window(self.window, new, seen, poses, size, overlap)
        self._withdraw_movers()
        self._insert(new)
        if new % self.config.keyframe_stride != 0:
            return  # Fast mode: this keyframe waits for the next optimisation.
        share = self.config.window_share
        probabilities = sampling_probabilities(len(self.keyframes), self.window, share)
        cameras = [self._online_camera] * self.config.keyframe_iterations
        self._optimise(cameras, probabilities, progress)

    def update_keyframes(
        self,
        T_camera_world: Tensor,  # (K, 4, 4) float64, of all keyframes in the map, in their order
        depths: list[Tensor | None] | None = None,  # K new reference depths, None where unchanged
    ) -> None:
        """Take over new poses and depths: the map moves with its anchor keyframes.

        Adam's moments are kept: a bundle adjustment moves the map by little.
        """
        count = len(self.keyframes)
        if len(T_camera_world) != count or (depths is not None and len(depths) != count):
            raise InputError(
                f"expected poses and depths of the {count} keyframes in the map, found "
                f"{len(T_camera_world)}; give all of them in the order of their integration"
            )
        old = torch.stack([keyframe.T_camera_world for keyframe in self.keyframes])
        rows = self._anchor_rows()
        gaussians = self.gaussians
        if depths is not None:
            before = [keyframe.depth for keyframe in self.keyframes]
            after = [b if d is None else d for b, d in zip(before, depths, strict=True)]
            gaussians = rescale_to_depths(gaussians, rows, old, before, after, self.camera)
            for keyframe, depth in zip(self.keyframes, after, strict=True):
                keyframe.set_depth(depth)
        gaussians = deform_rigidly(gaussians, rows, old, T_camera_world.double())
        self._optimizer.replace(gaussians)
        for keyframe, pose in zip(self.keyframes, T_camera_world.double(), strict=True):
            keyframe.T_camera_world = pose

    def refine(self, iterations: int, progress: Progress | None = None, done: int = 0) -> None:
        """Optimise map and MLP over all keyframes, the last part at full image size.

        It can be taken up again in another process after the iterations that are done.
        """
        if done == 0:
            self._exchange_movers()
        count = len(self.keyframes)
        uniform = torch.full((count,), 1 / count, dtype=torch.float64)
        full = round(iterations * self.config.refine_full_share)
        cameras = [self._online_camera] * (iterations - full) + [self.camera] * full
        self._optimise(cameras, uniform, progress, self.config.refine_rate_end, done)

    def _anchor_rows(self) -> Tensor:
        """Return (N,) the position in `keyframes` of each Gaussian's anchor."""
        anchors = self._optimizer.gaussians.anchor_keyframe
        return torch.searchsorted(
            anchors.new_tensor([keyframe.keyframe_index for keyframe in self.keyframes]), anchors
        )

    def refine_pose(
        self,
        T_camera_world: Tensor,  # (4, 4) float64
        image: Tensor,  # (H, W, 3) RGB in [0, 1] of a frame that is no keyframe
        beta: Tensor,  # (h', w') of that frame
    ) -> Tensor:  # (4, 4) float64
        """Return the pose near the given one from which the map looks most like the image."""
        weight = self._weight_of(beta, self.camera)
        settings = self.config.pose_refinement
        return refine_pose(
            self.gaussians, self.camera, T_camera_world, image, weight, self.background, settings
        )

    def beta_of(self, keyframe: MappedKeyframe) -> Tensor:
        """Return the raw beta (h', w') of a keyframe: that of its given mask, or the MLP's."""
        if keyframe.given_beta is not None:
            return keyframe.given_beta
        return self.predict_beta(keyframe.features)

    def _weight(self, keyframe: MappedKeyframe, camera: Camera) -> Tensor:
        """Return the static weight (H, W) of a keyframe."""
        return self._weight_of(self.beta_of(keyframe), camera)

    def _weight_of(self, beta: Tensor, camera: Camera) -> Tensor:
        """Return the static weight (H, W) for a beta; 1 with uncertainty switched off."""
        if not self.uncertainty.enabled:
            return torch.ones(camera.height, camera.width, device=beta.device)
        return mapping_weight(beta, camera)

    @torch.no_grad()
    def _seen(self, position: int) -> Tensor:
        """Return (N,) bool, the Gaussians that contribute to a keyframe."""
        pose = self.keyframes[position].T_camera_world
        rendering = self.render(pose, self._online_camera)
        return rendering.contribution > self.config.visible_contribution

    @torch.no_grad()
    def _insert(self, position: int) -> None:
        """Add Gaussians for what a keyframe sees and the map does not explain."""
        keyframe = self.keyframes[position]
        config = self.config.insertion
        rendering = self.render(keyframe.T_camera_world) if len(self.gaussians) else None
        weight = self._weight(keyframe, self.camera)
        far = config.far_factor * self.median_depth
        allowed = insertable_pixels(keyframe.depth, far, weight, rendering, config)
        pixels = draw_pixels(keyframe.depth > 0, config.cell, self._generator)
        pixels = pixels[allowed[pixels[:, 1], pixels[:, 0]]]
        new = gaussians_at_pixels(
            pixels,
            keyframe.image,
            keyframe.depth,
            self.camera,
            keyframe.T_camera_world,
            keyframe.keyframe_index,
            config,
        )
        self._optimizer.append(new)
        self._gradients = ScreenGradients(len(self.gaussians))

    def _withdraw_movers(self) -> None:
        """Remove Gaussians that were inserted on a mover before the MLP knew it for one."""
        gaussians, rows = self.gaussians, self._anchor_rows()
        keep = torch.ones_like(rows, dtype=torch.bool)
        for position, keyframe in enumerate(self.keyframes):
            anchored = (rows == position).nonzero().squeeze(-1)
            weight = self._weight(keyframe, self._online_camera)
            pose = keyframe.T_camera_world
            means = gaussians.means[anchored]
            keep[anchored] = ~lies_on_mover(means, self._online_camera, pose, weight)
        self._optimizer.prune(keep)
        self._gradients = ScreenGradients(len(self.gaussians))

    def _exchange_movers(self) -> None:
        """Withdraw movers and fill the holes that they leave, from every keyframe."""
        self._withdraw_movers()
        for position in range(len(self.keyframes)):
            self._insert(position)

    def _optimise(
        self,
        cameras: list[Camera],  # size at which each iteration renders
        probabilities: Tensor,  # (K,) of the keyframes
        progress: Progress | None,
        last_rate: float = 1.0,  # all steps shrink to this share of themselves, log-linear
        first: int = 0,  # iteration to begin with
    ) -> None:
        """Run the iterations, each on a keyframe drawn at random."""
        if len(self._optimizer.gaussians) == 0:
            return  # There is nothing to optimise: all was pruned, or nothing was inserted.
        for done in range(first, len(cameras)):
            position = torch.multinomial(probabilities, 1, generator=self._generator)
            self._step(int(position), cameras[done], last_rate ** (done / len(cameras)))
            if self._iteration % self.config.density.interval == 0:
                self._change_density()
            if progress is not None:
                progress(done + 1, len(cameras))

    def _step(self, position: int, camera: Camera, rate_factor: float) -> None:
        """Take one step of the map on L_render and one of the MLP on L_uncer."""
        keyframe = self.keyframes[position]
        view = keyframe.view(camera)
        gaussians = self._optimizer.gaussians
        offsets = torch.zeros_like(gaussians.means[:, :2], requires_grad=True)
        pose = keyframe.T_camera_world.float()
        rendering = render(gaussians, camera, pose, self.background, screen_offsets=offsets)
        weight = self._weight(keyframe, camera)
        loss = render_loss(
            gaussians, rendering, view.image, view.depth, weight, self.median_depth, self.config
        )
        loss.total.backward()
        self._gradients.add(offsets.grad, rendering.radii, camera)
        rates = self.config.rates_at(self._iteration, self.median_depth, rate_factor)
        self._optimizer.rates = rates
        self._optimizer.step()

        uncertainty = math.nan
        if self.uncertainty.is_learnt and self._iteration >= self._frozen_until:
            uncertainty = self._train_mlp(position, rendering)
        self.history.add(loss, uncertainty, len(gaussians))
        self._iteration += 1

    def _train_mlp(self, position: int, rendering: Rendering) -> float:
        """Take one step of the MLP on a rendering, as a constant, and return L_uncer."""
        features = self.keyframes[position].features
        reach = self.uncertainty.neighbour_keyframes
        nearby = self.keyframes[max(0, position - reach) : position + reach + 1]
        cells = torch.cat([k.features.reshape(-1, features.shape[-1]) for k in nearby])
        depth_unit = self.median_depth / self.config.metric_median
        misfit = keyframe_misfit(
            self.keyframes[position], rendering, self._online_camera, depth_unit, self.uncertainty
        )
        return self._trainer.step(features, misfit, cells)

    def _change_density(self) -> None:
        """Clone, split and prune, then let the map settle before the MLP learns again."""
        config = self.config.density
        densify(self._optimizer, self._gradients.mean, self.median_depth, config, self._generator)
        self._optimizer.prune(useful_rows(self.gaussians, self.median_depth, config))
        self._gradients = ScreenGradients(len(self.gaussians))
        self._frozen_until = self._iteration + self.config.freeze_iterations
