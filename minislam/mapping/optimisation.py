"""Optimise the map on L_render and the uncertainty MLP on L_uncer, in turn."""

import math
import operator
from collections.abc import Iterator
from dataclasses import replace
from functools import partial, reduce
from typing import Any

import torch
from torch import Tensor

from minislam.geometry import Camera
from minislam.mapping.config import MappingConfig
from minislam.mapping.density import densify, useful_rows
from minislam.mapping.losses import metre
from minislam.mapping.safeguards import confirmed_beta, without_acquitted
from minislam.mapping.views import Comparison, View, ViewGradients, view_gradients
from minislam.mapping.window import in_turn
from minislam.records import MapImage, Progress
from minislam.splatting import GaussianMap, LearningRates, MapOptimizer, Rendering, render
from minislam.state.memory import SHELF, release
from minislam.state.stateful import FrameOf, Stateful, Tree
from minislam.state.threads import side_by_side
from minislam.uncertainty import RenderingError, UncertaintyConfig, UncertaintyMLP, beta_of_mask
from minislam.uncertainty.training import UncertaintyTrainer
from minislam.uncertainty.weights import BETA_OF_MASK, MAPPING_CUT, UNIT_BETA, mapping_weight
from minislam.workers import Workers

# The weighted mean of L_color; L_uncer is nan where the MLP is frozen or off; size of the map.
CURVES = "L_render", "L_color", "L_uncer", "Gaussians"


class JointOptimisation(Stateful):
    """Map, MLP and images, and the iterations that optimise map and MLP, which `Mapper` starts."""

    camera: Camera  # of the images; the tracker may refine its focal length
    images: list[MapImage]
    window: list[int]  # positions in `images`, newest first
    median_depth: float = 1.0  # world units, of the images that the map is begun with
    cell: int  # px, side of the square that gets one Gaussian
    least_weight: float = MAPPING_CUT  # a pixel with less is excluded
    background: Tensor  # RGB of what no image shows
    history: dict[str, list[float]]  # for plots, by the names in CURVES, an entry per iteration
    shown: list[float]  # by image, the fraction of its static pixels that the map shows [-]
    _trainer: UncertaintyTrainer
    _generator: torch.Generator
    _optimizer: MapOptimizer
    _gradients: Tensor  # (2, N) screen gradients of the views since the last change of density
    _iteration: int = 0
    _frozen_until: int = 0  # iteration before which the MLP is not trained
    _weighted_from: int = 0  # iteration before which beta weights nothing

    def __init__(
        self,
        camera: Camera,  # of the images
        config: MappingConfig,
        uncertainty: UncertaintyConfig,
        feature_dimension: int,  # C
        seed: int,
        device: str = "cpu",  # of all tensors; images must be there, too
        workers: Workers | None = None,  # render the views of a step
        cell: int | None = None,  # px; None: that of the configuration
    ) -> None:
        self.camera, self.config, self.uncertainty, self.seed = camera, config, uncertainty, seed
        self.cell = cell or config.insertion.cell
        self.images, self.window, self.shown = [], [], []
        self.background = torch.zeros(3, device=device)
        self.history = {name: [] for name in CURVES}
        self._workers = workers or Workers()
        self._trainer = UncertaintyTrainer(feature_dimension, uncertainty, seed, device)
        self._generator = torch.Generator().manual_seed(seed + 1)
        self._optimizer = MapOptimizer(GaussianMap.empty(device=device), LearningRates())
        self._reset_gradients()

    def restore_state(self, state: Tree, frame_of: FrameOf) -> None:
        super().restore_state(state, frame_of)
        for image in self.images:
            SHELF.put([image.pixels, image.features, image.depth])

    @property
    def gaussians(self) -> GaussianMap:
        """Return the map, without gradients."""
        return self._optimizer.gaussians.detach()

    @property
    def _online_camera(self) -> Camera:
        """Return the camera of images of `image_scale`: all online, most in the refinement."""
        sides = self.camera.width, self.camera.height
        return self.camera.resized(*(max(1, round(self.config.image_scale * s)) for s in sides))

    @property
    def exposures(self) -> dict[int, Tensor]:
        """Return the exposures (3,) of the images, by frame index; without differences, none."""
        return {i.frame_index: i.exposure for i in self.images if i.exposure is not None}

    @property
    def mlp(self) -> UncertaintyMLP:
        """Return the uncertainty MLP."""
        return self._trainer.mlp

    @torch.no_grad()
    def render(self, T_camera_world: Tensor, camera: Camera | None = None) -> Rendering:
        """Render the map from a pose (4, 4), without gradients."""
        camera = camera or self.camera
        return render(self.gaussians, camera, T_camera_world, self.background)

    def renderings(self, images: list[MapImage]) -> Iterator[Rendering]:
        """Yield what the map shows of each image; the workers render side by side."""
        first, last = (self.gaussians, self.camera), (self.background, None, None)
        calls = ((*first, image.T_camera_world, *last) for image in images)
        return (Rendering(*found) for found in self._workers.stream(render, calls))

    def predict_beta(self, features: Tensor) -> Tensor:
        """Return the raw beta (h', w') of features (h', w', C)."""
        return self._trainer.predict(features)

    def beta_of(self, image: MapImage) -> Tensor:
        """Return the raw beta (h', w') of an image: from its mask, or from the MLP and the votes.

        Where views of other times look through the image, it is that of a mask: something moves.
        """
        release()  # all that goes from image to image passes here
        if image.moving_mask is not None:
            return beta_of_mask(image.moving_mask)
        beta = self.learned_beta(image)
        if image.confirmation is None:
            return beta
        return torch.where(image.confirmation < 0, BETA_OF_MASK, beta)

    def learned_beta(self, image: MapImage) -> Tensor:
        """Return the MLP's raw beta (h', w'), less where views confirm; of weight 1 at first."""
        beta = confirmed_beta(self.predict_beta(image.features), image.confirmation)
        is_trained = self._iteration >= self._weighted_from
        return beta if is_trained else torch.full_like(beta, UNIT_BETA)

    def static_weight(self, beta: Tensor, camera: Camera) -> Tensor:
        """Return the static weight (H, W) for a raw beta; 1 with uncertainty off."""
        if not self.uncertainty.enabled:
            return torch.ones(camera.height, camera.width, device=beta.device)
        return mapping_weight(beta, camera, self.least_weight)

    def _optimise(
        self,
        cameras: list[Camera],  # size at which each iteration renders
        probabilities: Tensor | None = None,  # (K,) of the images; None: all in turn
        progress: Progress | None = None,
        last_rate: float = 1.0,  # last step over the first one, log-linear in between
        iterations: range | None = None,  # of the cameras; None: all
    ) -> None:
        """Run the iterations. Each renders one image; a few make a step."""
        if len(self._optimizer.gaussians) == 0:
            return  # There is nothing to optimise: all was pruned, or nothing was inserted.
        interval, views = self.config.density.interval, self.config.views_per_step
        total = len(cameras)
        for done in (range(total) if iterations is None else iterations)[::views]:
            count = min(views, total - done)
            if probabilities is None:
                positions = in_turn(range(done, done + count), len(self.images), self.seed)
            else:
                repeats = int((probabilities > 0).sum()) < count  # else none twice
                drawn = torch.multinomial(probabilities, count, repeats, generator=self._generator)
                positions = drawn.tolist()
            rounds = self._iteration // interval
            self._step(positions, cameras[done], last_rate ** (done / total))
            if self._iteration // interval > rounds:
                self._change_density()
            if progress is not None:
                progress(done + count, total)

    def _step(self, positions: list[int], camera: Camera, rate_factor: float) -> None:
        """Take one step of the map on the mean L_render of some images, and one of the MLP."""
        trains = self.uncertainty.is_learned and self._iteration >= self._frozen_until
        calls = [self._view_arguments(self.images[k], camera, trains) for k in positions]
        views: list[ViewGradients] = self._workers.map(view_gradients, calls)
        for name, values in self._optimizer.gaussians.parameters.items():
            gradients = [view.by_parameter[name] for view in views]
            values.grad = reduce(torch.add, gradients) / len(views)
        self._gradients += reduce(torch.add, [view.screen for view in views])
        factor = rate_factor * math.sqrt(len(views))  # the mean of n gradients is less noisy
        self._optimizer.rates = self.config.rates_at(self._iteration, self.median_depth, factor)
        learn = partial(self._train_mlp, positions, views) if trains else lambda: math.nan
        _, loss = side_by_side(operator.call, [(self._optimizer.step,), (learn,)])
        for position, view in zip(positions, views, strict=True):
            if view.error is not None:
                image = self.images[position]
                left = without_acquitted(image.confirmation, view.error, self.uncertainty)
                self.images[position] = replace(image, confirmation=left)
            entry = *view.losses, loss, len(self._optimizer.gaussians)
            for curve, value in zip(CURVES, entry, strict=True):
                self.history[curve].append(value)
        self._iteration += len(views)

    def _view_arguments(self, image: MapImage, camera: Camera, trains: bool) -> tuple[Any, ...]:
        """Return the arguments of `view_gradients`."""
        comparison = None
        if trains:
            (rows, columns, _), unit = image.features.shape, metre(self.median_depth)
            grid = self._online_camera, (rows, columns), image.confirmation
            comparison = Comparison(*grid, unit, self.uncertainty)
        pose, weight = image.T_camera_world, self.static_weight(self.beta_of(image), camera)
        whole = View(image.pixels, image.depth, image.exposure)
        view = camera, pose, self.background, whole, weight
        return self.gaussians, *view, self.median_depth, self.config, comparison

    def _train_mlp(self, positions: list[int], views: list[ViewGradients]) -> float:
        """Take one step of the MLP on the rendering errors of some images; return L_uncer."""
        reach, every = self.uncertainty.neighbour_keyframes, range(len(self.images))
        nearby = {k for at in positions for k in every[max(0, at - reach) : at + reach + 1]}
        around = torch.cat([self.images[k].features.flatten(0, 1) for k in sorted(nearby)])
        features = torch.stack([self.images[position].features for position in positions])
        error = RenderingError.stacked(view.error for view in views if view.error is not None)
        return self._trainer.step(features, error, around)

    def _reset_gradients(self) -> None:
        self._gradients = self.gaussians.means.new_zeros(2, len(self.gaussians))

    def _change_density(self) -> None:
        """Clone, split and prune, then let the map settle before the MLP learns again."""
        config = self.config.density
        densify(self._optimizer, self._gradients, self.median_depth, config, self._generator)
        poses = torch.stack([image.T_camera_world for image in self.images])
        self._optimizer.keep(useful_rows(self.gaussians, poses, self.median_depth))
        self._reset_gradients()
        self._frozen_until = self._iteration + self.config.freeze_iterations
