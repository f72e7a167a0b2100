import math
from dataclasses import replace

import pytest
import torch

from minislam.mapping import optimisation
from minislam.mapping.config import DensityConfig
from minislam.mapping.views import view_gradients
from minislam.uncertainty import UncertaintyConfig
from minislam.workers import Workers
from tests.mapping.plane_scene import CAMERA, CONFIG, GRID, make_mapper, wall_keyframe

# Known answers


def test_the_mlp_rests_until_the_map_has_settled_after_a_change_of_density():
    config = replace(
        CONFIG,
        init_iterations=35,
        freeze_iterations=4,
        density=DensityConfig(interval=10, max_gaussians=10**6),
    )
    mapper = make_mapper(config)
    mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
    resting = [k for k, loss in enumerate(mapper.history["L_uncer"]) if math.isnan(loss)]
    assert resting == [10, 11, 12, 13, 20, 21, 22, 23, 30, 31, 32, 33]
    assert len(set(mapper.history["Gaussians"])) > 1


def test_progress_counts_to_the_end():
    calls = []
    mapper = make_mapper(replace(CONFIG, init_iterations=5))
    mapper.initialise([wall_keyframe(0)], lambda done, total: calls.append((done, total)))
    assert calls == [(2, 5), (4, 5), (5, 5)]  # two views make a step
    assert GRID == tuple(mapper.predict_beta(wall_keyframe(0).features).shape)


# Identities


@pytest.mark.parametrize("count", [1, 2])
def test_workers_render_what_this_process_renders(count: int):
    with Workers(count) as workers:
        mapper = make_mapper(CONFIG, workers=workers)
        mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
        mapper.background = torch.tensor([0.1, 0.2, 0.3])
        found = list(mapper.renderings(mapper.images))
    assert len(found) == 2 and not torch.equal(found[0].color, found[1].color)
    for keyframe, rendering in zip(mapper.images, found, strict=True):
        expected = mapper.render(keyframe.T_camera_world)
        assert all(map(torch.equal, rendering, expected))
        assert not any(part.requires_grad for part in rendering)


# Gradients


def test_each_loss_trains_only_its_own_side():
    mapper = make_mapper(replace(CONFIG, init_iterations=1))
    mapper.initialise([wall_keyframe(0), wall_keyframe(1)])
    weights = [p.detach().clone() for p in mapper.mlp.parameters()]
    means = mapper.gaussians.means.clone()

    mapper._frozen_until = 10**9  # only L_render steps: the MLP must not move nor get a gradient
    for parameter in mapper.mlp.parameters():
        parameter.grad = None
    mapper.refine(2)
    assert all(parameter.grad is None for parameter in mapper.mlp.parameters())
    assert all(torch.equal(a, b) for a, b in zip(weights, mapper.mlp.parameters(), strict=True))
    assert not torch.equal(means, mapper.gaussians.means)

    share = view_gradients(*mapper._view_arguments(mapper.images[0], CAMERA, True))
    mapper._train_mlp([0], [share])
    leaves = mapper._optimizer.gaussians.parameters.values()
    assert all(leaf.grad is None for leaf in leaves)
    assert not torch.equal(weights[0], mapper.mlp.weights[0])


def test_without_uncertainty_all_weights_are_one_and_the_mlp_rests():
    mapper = make_mapper(replace(CONFIG, init_iterations=3), UncertaintyConfig(enabled=False))
    mapper.initialise([wall_keyframe(0)])
    weight = mapper.static_weight(mapper.beta_of(mapper.images[0]), CAMERA)
    assert torch.equal(weight, torch.ones(24, 32))
    assert all(parameter.grad is None for parameter in mapper.mlp.parameters())


def test_what_was_read_of_the_images_before_is_released_with_every_beta(
    monkeypatch: pytest.MonkeyPatch,
):
    mapper, released = make_mapper(), []
    monkeypatch.setattr(optimisation, "release", lambda: released.append(None))
    for count in (1, 2):
        mapper.beta_of(wall_keyframe(count))
        assert len(released) == count


def test_the_mlp_also_looks_at_the_images_before_and_after(monkeypatch: pytest.MonkeyPatch):
    mapper, around = make_mapper(replace(CONFIG, init_iterations=1)), []
    mapper.initialise([wall_keyframe(k) for k in range(7)])
    share = view_gradients(*mapper._view_arguments(mapper.images[0], CAMERA, True))
    for k, image in enumerate(mapper.images):
        mapper.images[k] = replace(image, features=torch.full((1, 1, 3), k))
    monkeypatch.setattr(mapper._trainer, "step", lambda *given: around.append(given[2][:, 0]))
    for positions in ([3], [0], [6], [0, 6]):
        mapper._train_mlp(positions, [share])
    assert [seen.tolist() for seen in around] == [
        [1, 2, 3, 4, 5], [0, 1, 2], [4, 5, 6], [0, 1, 2, 4, 5, 6]
    ]  # fmt: skip


def test_online_images_have_the_size_of_image_scale():
    mapper = make_mapper(replace(CONFIG, image_scale=0.5))
    assert mapper._online_camera == CAMERA.resized(16, 12)
