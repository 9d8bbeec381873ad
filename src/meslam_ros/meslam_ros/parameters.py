"""ROS parameters out of typed settings, with descriptors, and back."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from meslam_core.config import MeslamConfig, settings
from meslam_core.errors import ConfigError
from meslam_core.setting import Setting

S = TypeVar("S")


def node_settings(kind: type) -> list[Setting]:
    """The settings of a node's own dataclass; their parameters have no section."""
    return [
        Setting(section="", name=field.name, default=field.default, **field.metadata)
        for field in dataclasses.fields(kind)
    ]


def declare_settings(node: Node, kind: type[S]) -> S:
    """Declare a node's own settings and return them as given at start.

    Raises:
        ConfigError: when a given value has the wrong type or is out of range.
    """
    return kind(**{entry.name: _declare(node, entry) for entry in node_settings(kind)})


def declare_config(node: Node, sections: Iterable[str]) -> MeslamConfig:
    """Declare `section.name` parameters of the method and return the configuration.

    Args:
        node: to declare on.
        sections: of `MeslamConfig` that the node uses; the rest keep their defaults.

    Raises:
        ConfigError: when a given value has the wrong type or is out of range.
    """
    wanted = set(sections)
    values: dict[str, dict[str, Any]] = {}
    for entry in settings():
        if entry.section in wanted:
            values.setdefault(entry.section, {})[entry.name] = _declare(node, entry)
    return MeslamConfig.from_mapping(values)


def descriptor(entry: Setting) -> ParameterDescriptor:
    """What `ros2 param describe` says about a setting.

    All are read only: the map depends on them, and a node takes them when it is configured.
    """
    constraints = f"one of: {', '.join(entry.choices)}" if entry.choices else ""
    result = ParameterDescriptor(
        name=entry.path,
        description=entry.meaning + (f" [{entry.unit}]" if entry.unit else ""),
        additional_constraints=constraints,
        read_only=True,
        # People write 4 where 4.0 is meant; `Setting.checked` takes both and says what it wants.
        dynamic_typing=True,
    )
    if entry.minimum is not None and entry.maximum is not None:
        if isinstance(entry.default, float):
            result.floating_point_range = [
                FloatingPointRange(from_value=float(entry.minimum), to_value=float(entry.maximum))
            ]
        elif isinstance(entry.default, int):
            result.integer_range = [
                IntegerRange(from_value=int(entry.minimum), to_value=int(entry.maximum), step=1)
            ]
    return result


def _declare(node: Node, entry: Setting) -> int | float | bool | str:
    try:
        value = node.declare_parameter(entry.path, entry.default, descriptor(entry)).value
    except ParameterException as error:
        override = node._parameter_overrides.get(entry.path)
        if override is not None:
            entry.checked(override.value)
        raise ConfigError(f"parameter {entry.path} cannot be used: {error}") from error
    return entry.checked(value)
