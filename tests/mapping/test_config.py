from dataclasses import fields, replace

import pytest

from minislam.config import SlamConfig, preset, with_settings
from minislam.errors import InputError
from minislam.mapping import MappingConfig
from minislam.parameters import leaves
from minislam.splatting import LearningRates


def test_steps_of_the_means_scale_with_the_scene_and_decay_to_their_end():
    config = MappingConfig(means_rate=1e-3, means_rate_end=0.01, rate_iterations=100)
    assert config.rates_at(0, 2.0, 1.0).means == pytest.approx(2e-3)
    assert config.rates_at(50, 2.0, 1.0).means == pytest.approx(2e-4)
    assert config.rates_at(100, 2.0, 1.0).means == pytest.approx(2e-5)
    assert config.rates_at(10**6, 2.0, 1.0).means == pytest.approx(2e-5)


def test_the_common_factor_reaches_every_parameter():
    config = MappingConfig()
    whole, half = config.rates_at(7, 1.0, 1.0), config.rates_at(7, 1.0, 0.5)
    for rate in fields(whole):
        assert getattr(half, rate.name) == pytest.approx(0.5 * getattr(whole, rate.name))


def test_each_image_of_a_long_sequence_has_its_share_of_the_refinement():
    config = MappingConfig(refine_iterations=400, refine_images=80)
    assert [config.refinement(images) for images in (8, 80, 81, 240)] == [400, 400, 405, 1200]
    assert replace(config, refine_images=0).refinement(240) == 400
    assert replace(config, refine_iterations=0).refinement(240) == 0


def test_every_constant_says_what_it_means():
    assert all(len(entry.metadata["meaning"]) > 10 for _, _, entry in leaves(MappingConfig()))


def test_impossible_values_are_refused_in_one_sentence():
    for name, value in (("image_scale", 0.0), ("window_size", 2), ("keyframe_stride", 0)):
        with pytest.raises(InputError, match=f"expected mapping.{name} of at least"):
            with_settings(SlamConfig(), {f"mapping.{name}": value})


def test_the_paper_values_are_the_official_ones():
    mapping = preset("paper").mapping
    # The step of the means of a scene of median depth 2 m, before and after its decay.
    assert mapping.rates_at(0, 2.0, 1.0).means == pytest.approx(9.6e-4)
    assert mapping.rates_at(30000, 2.0, 1.0).means == pytest.approx(9.6e-6)
    assert (mapping.init_iterations, mapping.keyframe_iterations) == (1050, 450)
    rates = mapping.rates_at(0, 2.0, 1.0)
    assert rates == LearningRates(), "the step lengths of the official code"
