"""What the interfaces ask for: our own priors have it, and each mistake is one sentence."""

import dataclasses

import pytest
import torch

from minislam import checks
from minislam.errors import InputError
from minislam.priors.conformance import (
    SHIFT,
    check_depth_prior,
    check_feature_extractor,
    check_flow_estimator,
    flow_error,
    shifted_images,
)
from minislam.priors.depth import NoDepth
from minislam.priors.features import ClassicalFeatures
from minislam.priors.flow import ClassicalChain, ClassicalFlow
from tests.helpers import generator


def gray_depth(frame, camera):
    return 1 + frame.image.mean(-1)


class Colours:
    """The mean colour of each patch: about the shortest features there are."""

    stride, dimension = 16, 3

    def __call__(self, frame):
        patches = frame.image.unflatten(0, (-1, self.stride)).unflatten(2, (-1, self.stride))
        return patches.mean((1, 3))


# Known answers


def test_our_own_priors_are_what_they_ask_for():
    checks.check_flow_estimator(ClassicalFlow())
    checks.check_feature_extractor(ClassicalFeatures())
    checks.check_feature_extractor(Colours())
    checks.check_depth_prior(NoDepth())
    checks.check_depth_prior(gray_depth)


def test_the_images_are_shifted_as_stated():
    first, second = shifted_images()
    assert torch.equal(first[4:, 8:], second[:-4, :-8])
    _, matches = ClassicalFlow().start_chain(first).advance(second)
    assert flow_error(matches, 8) < 0.05 and flow_error(matches, 8, (0, 0)) > 8.5


# Errors: depth


def changed(frame, camera):
    frame.image.mul_(0.5)
    return gray_depth(frame, camera)


WRONG_DEPTHS = {
    "found (160, 224, 3)": lambda frame, camera: frame.image,
    "found (224, 160)": lambda frame, camera: gray_depth(frame, camera).T,
    "torch.float64 on cpu": lambda frame, camera: gray_depth(frame, camera).double(),
    "found ndarray": lambda frame, camera: gray_depth(frame, camera).numpy(),
    "not all finite": lambda frame, camera: gray_depth(frame, camera) / 0,
    "on cpu, not all finite": lambda frame, camera: gray_depth(frame, camera) * torch.nan,
    "found -1": lambda frame, camera: -gray_depth(frame, camera),
    "found 0 to 0": lambda frame, camera: 0 * gray_depth(frame, camera),
    "on cpu with gradients": lambda frame, camera: gray_depth(frame, camera).requires_grad_(),
    "found it changed; copy": changed,
    "TypeError": lambda frame: gray_depth(frame, None),
    "ValueError: no": lambda frame, camera: (_ for _ in ()).throw(ValueError("no")),
    "expected __call__ of the depth prior": 3,
}


@pytest.mark.parametrize("words", WRONG_DEPTHS)
def test_a_wrong_depth_is_one_sentence(words: str):
    with pytest.raises(InputError) as caught:
        check_depth_prior(WRONG_DEPTHS[words])
    said = str(caught.value)
    assert said.startswith("expected ") and words in said and "\n" not in said


def test_depth_that_is_drawn_at_random_is_refused():
    source = generator(0)
    with pytest.raises(InputError, match=r"the same numbers, found others the second time"):
        check_depth_prior(lambda frame, camera: torch.rand(160, 224, generator=source))


@pytest.mark.parametrize("known", [(True, True, False), (False, True, True)])
def test_depth_that_is_known_only_at_times_is_refused(known: tuple[bool, ...]):
    times = iter(known)
    with pytest.raises(InputError, match=r"the same numbers, found others the second time"):
        check_depth_prior(lambda *a: gray_depth(*a) if next(times) else None)


# Errors: features


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stride": 0}, "whole number stride >= 1, found 0"),
        ({"dimension": None}, "whole number dimension >= 1, found None"),
        ({"dimension": 4}, "a finite tensor (10, 14, 4) torch.float32"),
        ({"stride": 8}, r"found (20, 28, 3)"),
        ({"__call__": lambda self, frame: torch.ones(10, 14, 3)}, "the same vector everywhere"),
    ],
)
def test_wrong_features_are_one_sentence(change: dict, words: str):
    features = type("Wrong", (Colours,), change)()
    if change == {"stride": 8}:
        features.stride, features.dimension = 8, 4
    with pytest.raises(InputError) as caught:
        check_feature_extractor(features)
    assert words in str(caught.value)


# Errors: flow


class Wrong(ClassicalFlow):
    """Right, but for one method that a test replaces."""

    def altered(self, **changes):
        usual = self.match
        self.match = lambda *a: dataclasses.replace(
            m := usual(*a), **{k: f(getattr(m, k)) for k, f in changes.items()}
        )
        return self


@pytest.mark.parametrize(
    ("flow", "words"),
    [
        (Wrong().altered(targets=lambda t: t.flip(1)), "found targets off by"),
        (Wrong().altered(targets=lambda t: t.mT), "found (2, 560, 2)"),
        (Wrong().altered(confidences=lambda c: 100 * c), "to return 0 to 1, found 0 to "),
        (Wrong().altered(matched_ratios=lambda r: r[:1]), "(matched_ratios) to return a fin"),
        (type("F", (Wrong,), {"match": lambda *a: None})(), "return FlowMatches, found NoneType"),
        (type("F", (Wrong,), {"saved_state": lambda s: {"a": [print]}})(), "text, found a builtin"),
        (type("F", (Wrong,), {"remove_frame": None})(), "expected remove_frame of the flow"),
        (type("F", (Wrong,), {"restore_chain": lambda s, *a: s.start_chain(shifted_images()[1])})(),
         "another answer"),
        (object(), "whole number stride >= 1"),
        (type("F", (), {"stride": 8})(), "say learned_confidence: True or False, found None"),
        (type("F", (Wrong,), {"disparity_damping": lambda s, k: torch.ones(k, 1)})(),
         "(disparity_damping) to return a finite tensor (2, 560)"),
    ],
)  # fmt: skip
def test_a_wrong_flow_is_one_sentence(flow, words: str):
    with pytest.raises(InputError) as caught:
        check_flow_estimator(flow)
    said = str(caught.value)
    assert words in said and said.startswith("expected ")


@pytest.mark.parametrize(
    ("mistake", "words"),
    [
        (lambda flow: -flow, "which fits the way back"),
        (lambda flow: flow.flip(1), r"which fits \(v, u\)"),
        (lambda flow: flow / 8, "which fits cells"),
        (lambda flow: 0 * flow, "off by 8.9 px, return"),
    ],
)
def test_the_known_mistakes_of_a_flow_are_named(mistake, words: str):
    pixels = torch.stack(
        torch.meshgrid(8.0 * torch.arange(28), 8.0 * torch.arange(20), indexing="xy")
    ).flatten(1)[None]
    flow = Wrong().altered(targets=lambda targets: pixels + mistake(targets - pixels))
    with pytest.raises(InputError, match=words):
        check_flow_estimator(flow)


def test_a_flow_that_drifts_and_a_chain_that_changes_are_refused():
    steps = iter(range(9))
    with pytest.raises(InputError, match=r"match as before after restore_state"):
        check_flow_estimator(Wrong().altered(targets=lambda t: t + 0.1 * next(steps)))

    class Changing(ClassicalChain):
        def restart(self):
            self.reference = self.newest
            return self

    def start(image):
        chain = ClassicalFlow().start_chain(image)
        chain.__class__ = Changing
        usual = chain.advance

        def advance(image):
            after, matches = usual(image)
            after.__class__ = Changing
            return after, matches

        chain.advance = advance
        return chain

    flow = Wrong()
    flow.start_chain = start
    with pytest.raises(InputError, match=r"the chain of the flow to stay as it is"):
        check_flow_estimator(flow)


def test_answers_that_take_another_form_later_are_refused():
    flow = Wrong()
    matches = iter([flow.match, lambda *a: None])
    flow.match = lambda *a: next(matches)(*a)
    with pytest.raises(InputError, match=r"after restore_state to return FlowMatches, found None"):
        check_flow_estimator(flow)

    class Alone(ClassicalChain):
        def advance(self, image):
            return super().advance(image)[1]

    flow = Wrong()
    flow.start_chain = lambda image: Alone(**vars(ClassicalFlow().start_chain(image)))
    with pytest.raises(InputError, match=r"return a chain and FlowMatches, found FlowMatches"):
        check_flow_estimator(flow)

    flow = Wrong()
    flow.restore_chain = lambda *a: Alone(**vars(ClassicalFlow().start_chain(shifted_images()[0])))
    with pytest.raises(InputError, match=r"return a chain and FlowMatches, found FlowMatches"):
        check_flow_estimator(flow)


def test_the_shift_has_two_different_parts():
    assert len({abs(part) for part in SHIFT}) == 2  # so exchanged ones are noticed
