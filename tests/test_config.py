"""The one tree of settings: presets, names with dots, JSON, and what a wrong value is told."""

import json
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path

import pytest

from minislam.config import (
    PRESETS,
    SlamConfig,
    preset,
    settings_in,
    settings_of,
    with_settings,
)
from minislam.errors import InputError
from minislam.parameters import absolute_path, flattened, leaves, user_path

CHANGED = {
    "seed": 7,
    "tracking.window": 4,
    "tracking.final_prior": True,
    "mapping.insertion.cell": 5,
    "mapping.image_scale": 0.25,
    "uncertainty.enabled": False,
    "networks.metric3d.size": (28, 84),
}


def from_json(tree: dict) -> SlamConfig:
    """Return the settings of a config.json."""
    return with_settings(SlamConfig(), settings_in(tree))


# Known answers


def test_laptop_is_the_default_tree():
    assert preset("laptop") == SlamConfig()


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_sets_what_it_says_and_nothing_else(name: str):
    expected = settings_of(SlamConfig()) | PRESETS[name]
    assert settings_of(preset(name)) == expected


def test_the_paper_presets_differ_as_its_supplement_says():
    paper, fast = settings_of(preset("paper")), settings_of(preset("paper-fast"))
    assert {name for name in paper if paper[name] != fast[name]} == {
        "tracking.prior_mask",  # no mask M
        "mapping.keyframe_stride",  # optimise every 5 keyframes
        "mapping.refine_iterations",  # 3000 iterations of final refinement
        "mapping.pose_refinement.enabled",  # no photometric refinement of the other frames
    }
    assert paper["mapping.refine_iterations"] == 20000
    assert (fast["mapping.keyframe_stride"], fast["mapping.refine_iterations"]) == (5, 3000)


def test_settings_of_deeper_parts_are_named_with_more_dots():
    names = settings_of(SlamConfig())
    assert {"seed", "tracking.window", "mapping.insertion.cell"} <= set(names)
    assert not any(is_dataclass(value) for value in names.values())


def test_every_setting_says_what_it_means():
    meanings = {name: entry.metadata["meaning"] for name, _, entry in leaves(SlamConfig())}
    assert set(meanings) == set(settings_of(SlamConfig()))
    assert [name for name, meaning in meanings.items() if len(meaning) < 8] == []


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("tracking.window", "12", 12),
        ("tracking.keyframe_flow", "7.5", 7.5),
        ("tracking.keyframe_flow", 7, 7.0),
        ("tracking.window", 12.0, 12),
        ("uncertainty.enabled", "off", False),
        ("uncertainty.enabled", "True", True),
        ("tracking.final_prior", "1", True),
        ("networks.metric3d.size", "28,56", (28, 56)),
        ("networks.metric3d.size", "(28, 56)", (28, 56)),
        ("networks.metric3d.size", [56, 28], (56, 28)),
    ],
)
def test_text_and_json_values_take_the_type_of_the_setting(name: str, text: object, value: object):
    found = settings_of(with_settings(SlamConfig(), {name: text}))[name]
    assert found == value and type(found) is type(value)


# Identities


def test_the_json_form_comes_back_the_same():
    config = with_settings(SlamConfig(), CHANGED)
    text = json.dumps(asdict(config))
    assert from_json(json.loads(text)) == config


def test_names_with_dots_and_nested_names_mean_the_same():
    nested = {"tracking": {"window": 4}, "mapping": {"insertion": {"cell": 5}}}
    assert flattened(nested) == {"tracking.window": 4, "mapping.insertion.cell": 5}
    assert from_json(nested) == with_settings(SlamConfig(), flattened(nested))


def test_a_changed_copy_leaves_the_original_alone():
    config = SlamConfig()
    with_settings(config, CHANGED)
    assert config == SlamConfig()


def test_what_is_left_out_keeps_its_default():
    assert from_json({}) == SlamConfig()


def test_all_parts_are_frozen():
    config = SlamConfig()
    parts = [getattr(config, entry.name) for entry in fields(config)]
    for part in [config, *(part for part in parts if is_dataclass(part))]:
        assert type(part).__dataclass_params__.frozen


def test_a_given_setting_of_the_tracker_holds_for_a_learned_flow_too():
    changed = with_settings(preset("paper"), {"tracking.window": "4"})
    assert changed.tracking.for_learned_flow().window == changed.tracking.window == 4
    both = with_settings(SlamConfig(), {"tracking.learned.window": 6, "tracking.window": 4})
    assert both.tracking.for_learned_flow().window == 6 and both.tracking.window == 4
    one = with_settings(SlamConfig(), {"tracking.learned.window": 6})
    assert one.tracking.window == SlamConfig().tracking.window


# Errors


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(InputError, match=r"'tracking.windw'; the nearest is tracking\.window"):
        with_settings(SlamConfig(), {"tracking.windw": 3})
    with pytest.raises(InputError, match=r"'mapping.insertion.cel'; .* mapping\.insertion\.cell"):
        from_json({"mapping": {"insertion": {"cel": 3}}})


@pytest.mark.parametrize("tree", [{"mapping": {"a": {}}}, {"mapping": {"a": {"b": {}}}}, {"a": {}}])
def test_an_unknown_name_with_nothing_in_it_is_refused_too(tree: dict):
    with pytest.raises(InputError, match=r"a known setting, found '(mapping\.a(\.b)?|a)'"):
        from_json(tree)


def test_a_part_with_nothing_in_it_keeps_its_defaults():
    assert from_json({"mapping": {}, "tracking": {"learned": {}}, "input": {}}) == SlamConfig()


def test_a_setting_is_no_part():
    with pytest.raises(InputError, match=r"expected tracking\.window to be of type int"):
        from_json({"tracking": {"window": {}}})


def test_an_unknown_preset_is_answered_with_all():
    with pytest.raises(InputError, match="laptop, paper, paper-fast, test, found 'desktop'"):
        preset("desktop")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tracking.window", "many"),
        ("tracking.window", 2.5),
        ("tracking.window", None),
        ("tracking.window", True),
        ("tracking.window", float("inf")),
        ("tracking.keyframe_flow", "nan"),
        ("tracking.keyframe_flow", "1,5"),
        ("uncertainty.enabled", "maybe"),
        ("networks.metric3d.size", "one,two"),
        ("networks.metric3d.size", 3),
        ("networks.metric3d.size", [616.5, 1064]),
        ("networks.metric3d.size", [616, True]),
    ],
)
def test_a_wrong_type_is_named_with_what_was_found(name: str, value: object):
    wanted = "(of type .*|a finite number.*)"
    with pytest.raises(InputError, match=f"expected {name} to be {wanted}, found"):
        with_settings(SlamConfig(), {name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", -1), ("seed", 10**22), ("threads", 0), ("threads", 100_000),
        ("checkpoint_fraction", -1), ("tracking.window", 0), ("tracking.window", -3),
        ("tracking.window", 10**22), ("tracking.learned.window", 0),
        ("mapping.init_iterations", -1), ("mapping.color_weight", 1.1),
        ("networks.metric3d.size", "28,0"),
        ("uncertainty.dropout", 1), ("uncertainty.grid_factor", 0), ("uncertainty.neighbours", 0),
        ("mapping.insertion.footprint", 0.0), ("tracking.warmup_keyframes", 1),
        ("uncertainty.learning_rate", 1.1), ("uncertainty.median_size", 0),
        ("mapping.insertion.cell", 1001), ("mapping.means_rate", 1.1),
        ("mapping.means_rate_end", 1.1), ("mapping.quats_rate", 1.1),
        ("mapping.log_scales_rate", 1.1), ("mapping.opacity_rate", 1.1),
        ("mapping.colors_rate", 1.1), ("mapping.refine_rate_end", 1.1),
    ],
)  # fmt: skip
def test_a_value_that_means_nothing_is_refused_with_its_bounds(name: str, value: object):
    with pytest.raises(InputError, match=f"expected {name} of at least .* and at most"):
        with_settings(SlamConfig(), {name: value})


def test_zero_passes_where_it_means_none():
    for name in ("tracking.global_interval", "mapping.refine_iterations", "checkpoint_fraction"):
        assert settings_of(with_settings(SlamConfig(), {name: 0}))[name] == 0


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_lies_within_the_bounds(name: str):
    with_settings(SlamConfig(), settings_of(preset(name)))


@pytest.mark.parametrize("tree", [[1, 2], "tracking", None, 3])
def test_settings_that_are_no_object_are_an_error(tree: object):
    with pytest.raises(InputError, match="as a JSON object"):
        flattened(tree)


def test_a_path_of_the_user_is_found_from_anywhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert user_path("~/a") == tmp_path / "a" and user_path("~nobodyhere/a") == Path(
        "~nobodyhere/a"
    )
    assert absolute_path("~/a") == absolute_path("a") == str(tmp_path / "a")
    assert absolute_path("files:a") == f"files:{tmp_path / 'a'}"
