"""All numbers of the system: defaults, units, ranges and meanings stand here and nowhere else.

The sections are declared in `tracking_config` and `mapping_config`. The YAML parameter files,
the ROS parameter descriptors and `docs/parameters.md` are generated
from these classes (`meslam_core.config_reference`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from meslam_core.errors import ConfigError
from meslam_core.mapping_config import (
    FieldConfig,
    KeyframesConfig,
    MapConfig,
    MappingConfig,
    RegionsConfig,
    RuntimeConfig,
)
from meslam_core.setting import Setting
from meslam_core.tracking_config import (
    OdometryConfig,
    RelocalisationConfig,
    SensorConfig,
    TrackingConfig,
)

__all__ = [
    "PRESETS",
    "FieldConfig",
    "KeyframesConfig",
    "MapConfig",
    "MappingConfig",
    "MeslamConfig",
    "OdometryConfig",
    "RegionsConfig",
    "RelocalisationConfig",
    "RuntimeConfig",
    "SensorConfig",
    "TrackingConfig",
    "settings",
]


MAX_OVERRIDE = 3000
"""Characters of a setting's text; numbers of more digits cannot be printed."""


@dataclass(frozen=True)
class MeslamConfig:
    """The whole configuration, one section a part of the system."""

    sensor: SensorConfig = SensorConfig()
    odometry: OdometryConfig = OdometryConfig()
    field: FieldConfig = FieldConfig()
    tracking: TrackingConfig = TrackingConfig()
    relocalisation: RelocalisationConfig = RelocalisationConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    mapping: MappingConfig = MappingConfig()
    regions: RegionsConfig = RegionsConfig()
    map: MapConfig = MapConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    @classmethod
    def from_mapping(cls, values: Mapping[str, Mapping[str, Any]]) -> MeslamConfig:
        """Defaults with `{section: {name: value}}` in their place.

        Raises:
            ConfigError: for unknown sections or names, wrong types, values out of range.
        """
        known = {(s.section, s.name): s for s in settings()}
        sections: dict[str, dict[str, Any]] = {}
        for section, entries in values.items():
            if not isinstance(entries, Mapping):
                raise ConfigError(f"section {section!r} holds {entries!r}, expected a mapping")
            for name, value in entries.items():
                if (section, name) not in known:
                    raise ConfigError(
                        f"there is no setting {section}.{name}; {_suggestion(section, name)}"
                    )
                sections.setdefault(section, {})[name] = known[section, name].checked(value)
        config = cls()
        return dataclasses.replace(
            config,
            **{s: dataclasses.replace(getattr(config, s), **v) for s, v in sections.items()},
        )

    @classmethod
    def from_overrides(cls, overrides: Sequence[str], preset: str = "default") -> MeslamConfig:
        """The configuration of a preset with `section.name=value` texts applied in order.

        Raises:
            ConfigError: as `from_mapping`, and for malformed texts or unknown presets.
        """
        if preset not in PRESETS:
            raise ConfigError(f"there is no preset {preset!r}; choose one of {', '.join(PRESETS)}")
        values: dict[str, dict[str, Any]] = {s: dict(v) for s, v in PRESETS[preset].items()}
        for text in overrides:
            path, equals, value = text.partition("=")
            section, dot, name = path.strip().partition(".")
            if not equals or not dot or len(text) > MAX_OVERRIDE:
                raise ConfigError(f"{text[:100]!r} is not of the form section.name=value")
            try:
                values.setdefault(section, {})[name] = _parsed(value)
            except (yaml.YAMLError, ValueError, RecursionError) as error:
                raise ConfigError(
                    f"the value of {text!r} is neither number nor text; "
                    "write section.name=value, such as field.width=64"
                ) from error
        return cls.from_mapping(values)

    def to_mapping(self) -> dict[str, dict[str, Any]]:
        """`{section: {name: value}}` of all settings."""
        return dataclasses.asdict(self)


def _parsed(text: str) -> Any:
    """A YAML scalar; YAML 1.1 takes 3e-4 for a string, people mean a number."""
    value = yaml.safe_load(text)
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _suggestion(section: str, name: str) -> str:
    names = [s.name for s in settings() if s.section == section]
    if names:
        return f"section {section} has {', '.join(names)}"
    return f"sections are {', '.join(f.name for f in dataclasses.fields(MeslamConfig))}"


def settings() -> Iterator[Setting]:
    """Every setting in the order of its declaration."""
    for section in dataclasses.fields(MeslamConfig):
        for entry in dataclasses.fields(type(getattr(MeslamConfig(), section.name))):
            default: Any = entry.default
            yield Setting(section.name, entry.name, default, **entry.metadata)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "default": {},
    "fine": {"field": {"width": 128}},
    "paper": {"field": {"width": 256}, "odometry": {"method": "colored_icp"}},
    # The paper's baseline: one network for a cube of 48 m, with nearly the default's frequencies
    # a metre; no odometry, and nothing registered.
    "imap_star": {
        "odometry": {"method": "none"},
        "field": {"width": 256, "embedding_sigma": 100.0},
        "keyframes": {"links": 0},
        "regions": {
            "single": True,
            "volume_m3": 110592.0,
            "mask_voxel_m": 0.16,
            "mask_extent": 1.0,
        },
    },
}
