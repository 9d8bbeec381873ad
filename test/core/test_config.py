"""The configuration: what is refused and how, and that generated files follow it."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from meslam_core import config_reference
from meslam_core.config import PRESETS, MeslamConfig, settings
from meslam_core.errors import ConfigError

ROOT = Path(__file__).parents[2]


def from_texts(*texts: str) -> MeslamConfig:
    return MeslamConfig.from_overrides(texts)


def test_overrides_are_applied_in_order():
    config = from_texts("mapping.rays=300", "odometry.method=colored_icp", "mapping.rays=400")
    assert config.mapping.rays == 400
    assert config.odometry.method == "colored_icp"
    assert config.mapping.iterations == MeslamConfig().mapping.iterations


@pytest.mark.parametrize(("text", "value"), [("3e-3", 3e-3), (" 0.01 ", 0.01), ("5e-04", 5e-4)])
def test_numbers_may_be_written_as_people_do(text, value):
    assert from_texts(f"tracking.convergence={text}").tracking.convergence == value


def test_a_whole_number_serves_for_a_measure():
    depth = from_texts("sensor.max_depth_m=4").sensor.max_depth_m
    assert depth == 4.0
    assert isinstance(depth, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mapping.rays", "not of the form section.name=value"),
        ("rays=3", "not of the form section.name=value"),
        ("mapping.beams=3", "no setting mapping.beams; section mapping has rays"),
        ("mappings.rays=3", "no setting mappings.rays; sections are sensor"),
        ("mapping.rays=3", r"mapping.rays = 3 is outside \[8, 20000\]"),
        ("mapping.rays=many", "'many' is str, expected int"),
        ("mapping.rays=10.5", "10.5 is float, expected int"),
        ("mapping.rays=true", "True is bool, expected int"),
        ("odometry.method=visual", "choose one of direct, hybrid, colored_icp"),
        ("sensor.max_depth_m=.nan", "outside"),
        ("sensor.max_depth_m=", "NoneType, expected float"),
        ("sensor.max_depth_m=[1, 2]", "list, expected float"),
        ("sensor.max_depth_m={", "neither number nor text"),
    ],
)
def test_what_makes_no_sense_is_refused_with_a_remedy(text, message):
    with pytest.raises(ConfigError, match=message):
        from_texts(text)


def test_an_unknown_preset_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="choose one of default, fine, paper"):
        MeslamConfig.from_overrides([], preset="fast")


def test_a_section_that_is_no_mapping_is_refused():
    with pytest.raises(ConfigError, match="section 'mapping' holds 3"):
        MeslamConfig.from_mapping({"mapping": 3})


def test_overrides_come_after_the_preset():
    config = MeslamConfig.from_overrides(["field.width=64"], preset="paper")
    assert config.odometry.method == "colored_icp"
    assert config.field.width == 64


@pytest.mark.parametrize("preset", PRESETS)
def test_a_configuration_survives_its_own_mapping(preset):
    config = MeslamConfig.from_overrides([], preset)
    assert MeslamConfig.from_mapping(config.to_mapping()) == config


@pytest.mark.parametrize("setting", list(settings()), ids=lambda setting: setting.path)
def test_every_setting_is_described_and_its_default_is_allowed(setting):
    assert setting.checked(setting.default) == setting.default
    assert len(setting.meaning) > 10
    numeric = isinstance(setting.default, int | float) and not isinstance(setting.default, bool)
    if numeric:
        assert setting.minimum is not None
        assert setting.maximum is not None
    suffixes = {"m": "_m", "s": "_s", "ms": "_ms", "deg": "_deg"}
    for unit, suffix in suffixes.items():
        if setting.name.endswith(suffix) and not setting.name.endswith(
            ("_m_s", "_deg_s", "_deg_m")
        ):
            assert setting.unit == unit


def test_the_generated_files_follow_the_configuration():
    names = config_reference.outdated(ROOT)
    assert names == [], "run `make config`"


def test_outdated_files_are_named(tmp_path, capsys):
    assert config_reference.main(["--root", str(tmp_path)]) == 0
    assert config_reference.main(["--root", str(tmp_path), "--check"]) == 0
    file = tmp_path / "config" / "meslam.yaml"
    rays = MeslamConfig().mapping.rays
    outdated = file.read_text().replace(f"rays: {rays}", f"rays: {rays + 1}")
    assert outdated != file.read_text()
    file.write_text(outdated)
    assert config_reference.main(["--root", str(tmp_path), "--check"]) == 1
    assert "config/meslam.yaml is out of date" in capsys.readouterr().err


def test_the_parameter_file_gives_back_every_default_with_its_type():
    text = config_reference.documents()["config/meslam.yaml"]
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert values == MeslamConfig().to_mapping()
    for setting in settings():
        assert type(values[setting.section][setting.name]) is type(setting.default)


@pytest.mark.parametrize("preset", [name for name, values in PRESETS.items() if values])
def test_a_presets_parameter_file_holds_what_it_changes(preset):
    text = config_reference.documents()[f"config/{preset}.yaml"]
    values = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert values == PRESETS[preset]


def test_the_reference_lists_every_setting():
    text = config_reference.documents()["docs/parameters.md"]
    for setting in settings():
        assert f"| `{setting.path}` |" in text


def test_a_range_of_depth_that_is_empty_is_refused():
    with pytest.raises(
        ConfigError, match=r"sensor\.min_depth_m = 4 m .* sensor\.max_depth_m = 1 m"
    ):
        MeslamConfig.from_overrides(["sensor.min_depth_m=4", "sensor.max_depth_m=1"])
