"""Optimise the map on L_render and the uncertainty MLP on L_uncer, one step of each in turn."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping.config import MappingConfig
from minislam.mapping.density import ScreenGradients, densify, useful_rows
from minislam.mapping.losses import MappingHistory, metre, render_loss
from minislam.mapping.views import MappedKeyframe, keyframe_rendering_error
from minislam.splatting import GaussianMap, LearningRates, MapOptimizer, Rendering, render
from minislam.state.stateful import Stateful
from minislam.uncertainty import (
    UncertaintyConfig,
    UncertaintyMLP,
    UncertaintyTrainer,
    mapping_weight,
)

CONFIRMED_BETA = 0.4  # fraction of beta that is taken away where other views confirm [-]

Progress = Callable[[int, int], None]  # called with the iterations done and their number


class JointOptimisation(Stateful):
    """The map, the MLP and the keyframes, and the iterations that optimise map and MLP.

    Which Gaussians there are, and when an optimisation runs, is decided in `mapper.py`.
    """

    camera: Camera  # of the keyframe images; the tracker may refine its focal length
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
    _frozen_until: int = 0  # iteration before which the MLP is not trained

    def __init__(
        self,
        camera: Camera,  # of the keyframe images
        config: MappingConfig,
        uncertainty: UncertaintyConfig,
        feature_dimension: int,  # C
        seed: int,
        device: str = "cpu",  # of all tensors; keyframes must be there, too
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
        self._optimizer = MapOptimizer(GaussianMap.empty(device=device), LearningRates())
        self._reset_gradients()

    @property
    def gaussians(self) -> GaussianMap:
        """Return the map, without gradients."""
        return self._optimizer.gaussians.detach()

    @property
    def _online_camera(self) -> Camera:
        sides = (self.camera.width, self.camera.height)
        return self.camera.resized(*(max(1, round(self.config.image_scale * s)) for s in sides))

    @property
    def mlp(self) -> UncertaintyMLP:
        """Return the uncertainty MLP."""
        return self._trainer.mlp

    @torch.no_grad()
    def render(self, T_camera_world: Tensor, camera: Camera | None = None) -> Rendering:
        """Render the map from a pose (4, 4), without gradients."""
        camera = camera or self.camera
        return render(self.gaussians, camera, T_camera_world.float(), self.background)

    def predict_beta(self, features: Tensor) -> Tensor:
        """Return the raw beta (h', w') of features (h', w', C)."""
        return self._trainer.predict(features)

    def beta_of(self, keyframe: MappedKeyframe) -> Tensor:
        """Return the raw beta (h', w') of a keyframe: from its mask or from the MLP."""
        if keyframe.given_beta is not None:
            return keyframe.given_beta
        beta, confirmation = self.predict_beta(keyframe.features), keyframe.confirmation
        return beta if confirmation is None else beta * (1 - CONFIRMED_BETA * confirmation)

    def static_weight(self, beta: Tensor, camera: Camera) -> Tensor:
        """Return the static weight (H, W) for a raw beta; 1 with uncertainty switched off."""
        if not self.uncertainty.enabled:
            return torch.ones(camera.height, camera.width, device=beta.device)
        return mapping_weight(beta, camera)

    def _optimise(
        self,
        cameras: list[Camera],  # size at which each iteration renders
        probabilities: Tensor,  # (K,) of the keyframes
        progress: Progress | None = None,
        last_rate: float = 1.0,  # last step over the first one, log-linear in between
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
        weight = self.static_weight(self.beta_of(keyframe), camera)
        loss = render_loss(
            gaussians, rendering, view.image, view.depth, weight, self.median_depth, self.config
        )
        loss.total.backward()
        assert offsets.grad is not None
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
        """Take one step of the MLP, for which the rendering is a constant; return L_uncer."""
        keyframe = self.keyframes[position]
        reach = self.uncertainty.neighbour_keyframes
        nearby = self.keyframes[max(0, position - reach) : position + reach + 1]
        cells = torch.cat([k.features.flatten(0, 1) for k in nearby])
        error = keyframe_rendering_error(
            keyframe, rendering, self._online_camera, metre(self.median_depth), self.uncertainty
        )
        return self._trainer.step(keyframe.features, error, cells)

    def _reset_gradients(self) -> None:
        self._gradients = ScreenGradients(self.gaussians.opacity_logits)

    def _change_density(self) -> None:
        """Clone, split and prune, then let the map settle before the MLP learns again."""
        config = self.config.density
        densify(self._optimizer, self._gradients.mean, self.median_depth, config, self._generator)
        self._optimizer.prune(useful_rows(self.gaussians, self.median_depth))
        self._reset_gradients()
        self._frozen_until = self._iteration + self.config.freeze_iterations
