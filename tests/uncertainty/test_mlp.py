import pytest
import torch

from minislam.uncertainty import UncertaintyMLP
from tests.helpers import assert_gradients_close, generator, numerical_gradient


def make_mlp(dimension: int = 6, seed: int = 0) -> UncertaintyMLP:
    return UncertaintyMLP(dimension, generator(seed))


# Known answers


def test_parameter_count_for_384_features_is_28865():
    # 384 * 64 + 64 + 64 * 64 + 64 + 64 + 1 = 24640 + 4160 + 65.
    assert sum(p.numel() for p in make_mlp(384).parameters()) == 28865


def test_zero_weights_give_softplus_of_the_last_bias():
    mlp = make_mlp()
    with torch.no_grad():
        for parameter in mlp.parameters():
            parameter.zero_()
    beta = mlp(torch.ones(2, 3, 6))
    assert beta.shape == (2, 3)
    torch.testing.assert_close(beta, torch.full((2, 3), 0.6931472))


# Identities


def test_same_seed_gives_the_same_network_and_the_global_source_is_untouched():
    before = torch.random.get_rng_state()
    first, second, other = make_mlp(seed=1), make_mlp(seed=1), make_mlp(seed=2)
    first(torch.ones(4, 6), generator(0))
    assert torch.equal(before, torch.random.get_rng_state())
    assert torch.equal(first.weights[0], second.weights[0])
    assert not torch.equal(first.weights[0], other.weights[0])


def test_inference_has_no_dropout_and_training_keeps_the_mean():
    mlp = make_mlp()
    features = torch.randn(5, 6, generator=generator(3))
    assert torch.equal(mlp(features), mlp(features))
    random = generator(4)
    assert not torch.equal(mlp(features, random), mlp(features, random))
    mask = mlp._dropout_mask(torch.ones(199, 101), random)
    assert abs(float(mask.mean()) - 1) < 0.01
    assert abs(float((mask == 0).float().mean()) - 0.2) < 0.01
    neighbours = (mask[:, 1:] == 0) & (mask[:, :-1] == 0)  # each unit for itself
    assert abs(float(neighbours.float().mean()) - 0.04) < 0.005


# Gradients


def test_gradient_agrees_with_finite_differences():
    mlp = make_mlp().double()
    features = torch.randn(7, 6, generator=generator(5), dtype=torch.float64)
    leaf = features.clone().requires_grad_()
    mlp(leaf).square().sum().backward()
    expected = numerical_gradient(lambda x: mlp(x).square().sum().detach(), features)
    assert_gradients_close(leaf.grad, expected, relative=1e-6)


# Degenerate input


@pytest.mark.parametrize("scale", [0.0, 1e4, -1e4])
def test_beta_is_positive_and_finite_for_any_feature(scale):
    beta = make_mlp()(scale * torch.ones(3, 6))
    assert torch.isfinite(beta).all() and (beta >= 0).all()


def test_the_first_biases_lie_on_both_sides_of_zero_within_their_bound():
    mlp = make_mlp(4)
    for bias, fan_in in zip(mlp.biases, (4, 64, 64), strict=True):
        assert bias.abs().max() <= fan_in**-0.5
    first = mlp.biases[0].detach()
    assert abs(float(first.mean())) < 0.1 < float(first.std())
