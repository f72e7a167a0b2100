import torch

from minislam.uncertainty import (
    RenderingError,
    UncertaintyConfig,
    UncertaintyTrainer,
    rendering_error,
)
from minislam.uncertainty.training import uncertainty_loss
from tests.helpers import assert_gradients_close, generator, numerical_gradient


def two_object_error() -> tuple[torch.Tensor, RenderingError]:
    """A grid whose left half is explained by the map and whose right half is not."""
    features = torch.zeros(6, 8, 4)
    features[:, :4, 0] = 1
    features[:, 4:, 1] = 1
    features = features + 0.05 * torch.randn(6, 8, 4, generator=generator(0))
    ssim = torch.zeros(6, 8)
    ssim[:, 4:] = 2.0
    return features, RenderingError(ssim, torch.zeros(6, 8), torch.ones(6, 8))


def test_the_mlp_learns_which_features_the_map_cannot_explain():
    features, error = two_object_error()
    trainer = UncertaintyTrainer(4, UncertaintyConfig(learning_rate=5e-3), seed=0)
    losses = [trainer.step(features, error, features.reshape(-1, 4)) for _ in range(250)]
    beta = trainer.predict(features)
    assert losses[-1] < losses[0]
    assert beta[:, :4].mean() < 0.4 and beta[:, 4:].mean() > 1.41


def test_a_step_on_two_equal_keyframes_is_one_on_either_but_longer():
    features, error = two_object_error()
    config = UncertaintyConfig(dropout=0.0, lambda_variance=0.0)
    steps = []
    for count in (1, 2):
        trainer = UncertaintyTrainer(4, config, seed=3)
        before = trainer.mlp.weights[0].detach().clone()
        both = RenderingError(*(torch.stack([e] * count) for e in vars(error).values()))
        trainer.step(torch.stack([features] * count), both, features.reshape(-1, 4))
        steps.append(trainer.mlp.weights[0].detach() - before)
    torch.testing.assert_close(steps[1], 2 * steps[0], rtol=1e-3, atol=1e-7)


def test_the_steps_are_those_of_adam():
    features, error = two_object_error()
    config = UncertaintyConfig(dropout=0.0, lambda_variance=0.0)
    trainer, other = (UncertaintyTrainer(4, config, seed=3) for _ in range(2))
    weights = list(other.mlp.parameters())
    decay = config.weight_decay
    adam = torch.optim.Adam(weights, lr=config.learning_rate, weight_decay=decay)
    for _ in range(5):
        trainer.step(features, error, features.reshape(-1, 4))
        adam.zero_grad()
        beta = other.mlp(features)
        uncertainty_loss(beta, error, beta.reshape(-1), features.reshape(-1, 4), config).backward()
        adam.step()
    for ours, theirs in zip(trainer.mlp.parameters(), weights, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-6)


def test_two_runs_with_one_seed_are_equal_to_the_bit():
    features, error = two_object_error()
    betas = []
    for _ in range(2):
        trainer = UncertaintyTrainer(4, UncertaintyConfig(), seed=3)
        for _ in range(5):
            trainer.step(features, error, features.reshape(-1, 4))
        betas.append(trainer.predict(features))
    assert torch.equal(betas[0], betas[1])


def test_the_rendering_error_passes_no_gradient_back_to_the_rendering():
    image = torch.rand(16, 16, 3, generator=generator(1))
    color = torch.rand(16, 16, 3, generator=generator(2)).requires_grad_()
    depth = torch.full((16, 16), 2.0, requires_grad=True)
    opacity = torch.ones(16, 16, requires_grad=True)
    error = rendering_error(
        image, torch.ones(16, 16), color, depth, opacity, (4, 4), 0.5, UncertaintyConfig()
    )
    trainer = UncertaintyTrainer(3, UncertaintyConfig(), seed=0)
    features = torch.rand(4, 4, 3, generator=generator(3))
    trainer.step(features, error, features.reshape(-1, 3))
    assert color.grad is None and depth.grad is None and opacity.grad is None
    # |2 - 1| in units of 0.5.
    torch.testing.assert_close(error.depth, torch.full((4, 4), 2.0))


def test_no_reference_depth_leaves_only_the_ssim_term():
    image = torch.rand(16, 16, 3, generator=generator(1))
    nothing = torch.zeros(16, 16)
    error = rendering_error(
        image, nothing, image, nothing + 2, nothing + 1, (4, 4), 1.0, UncertaintyConfig()
    )
    assert error.depth.max() == 0 and error.ssim.max() == 0


def test_the_gradient_of_the_whole_loss_agrees_with_finite_differences():
    config = UncertaintyConfig()
    features, error = two_object_error()
    features = features[::3, ::2].double()
    error = RenderingError(*(t[::3, ::2].double() for t in (error.ssim, error.depth + 0.3,
                                                      error.opacity)))  # fmt: skip
    cells = features.reshape(-1, 4)

    def loss(beta: torch.Tensor) -> torch.Tensor:
        return uncertainty_loss(beta, error, beta.reshape(-1), cells, config)

    beta = 0.2 + torch.rand(2, 4, generator=generator(4), dtype=torch.float64)
    leaf = beta.clone().requires_grad_()
    loss(leaf).backward()
    assert_gradients_close(leaf.grad, numerical_gradient(loss, beta), relative=1e-6)


def test_each_lambda_scales_its_own_term():
    features, error = two_object_error()
    error = RenderingError(error.ssim, torch.full((6, 8), 0.4), error.opacity)
    beta = 0.5 + torch.rand(6, 8, generator=generator(5))
    cells = features.reshape(-1, 4)

    def loss(depth: float, variance: float, log: float) -> float:
        config = UncertaintyConfig(lambda_depth=depth, lambda_variance=variance, lambda_log=log)
        return float(uncertainty_loss(beta, error, beta.reshape(-1), cells, config))

    clipped = beta + 0.001
    alone = float((error.ssim / clipped**2).mean())
    assert abs(loss(0, 0, 0) - alone) < 1e-5
    assert abs(loss(0.2, 0, 0) - alone - float((0.08 / clipped**2).mean())) < 1e-5
    assert abs(loss(0, 0, 0.5) - alone - 0.5 * float(clipped.log().mean())) < 1e-5
    assert loss(0, 1, 0) - alone > 0.01 and abs(loss(0, 2, 0) + alone - 2 * loss(0, 1, 0)) < 1e-5


def test_a_reference_far_beyond_the_scene_is_not_used_in_any_world_unit():
    image, ones = torch.rand(16, 16, 3, generator=generator(1)), torch.ones(16, 16)
    for unit in (0.01, 100.0):
        for far, is_used in ((9.0, True), (11.0, False)):  # median depths
            reference = unit * ones
            reference[:4] *= far
            seen = image, reference, image, unit * ones, ones
            error = rendering_error(*seen, (4, 4), unit, UncertaintyConfig())
            assert bool(error.depth.any()) == is_used
