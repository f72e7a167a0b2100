from dataclasses import fields

import pytest

from minislam.config import preset
from minislam.errors import InputError
from minislam.uncertainty import UncertaintyConfig


def test_every_constant_says_what_it_means():
    assert all(len(constant.metadata["meaning"]) > 10 for constant in fields(UncertaintyConfig))


def test_beta_is_learned_unless_it_is_switched_off_or_given():
    assert UncertaintyConfig().is_learned
    assert not UncertaintyConfig(enabled=False).is_learned
    assert not UncertaintyConfig(given_masks=True).is_learned


def test_the_paper_values_are_the_official_ones():
    paper = preset("paper").uncertainty
    assert (paper.lambda_depth, paper.learning_rate, paper.median_size) == (0.2, 4e-4, 5)


# Errors


def test_impossible_values_are_refused_in_one_sentence():
    with pytest.raises(InputError, match="odd median window"):
        UncertaintyConfig(median_size=4)
