"""ROS parameters out of typed settings, with descriptors, and back.

Settings marked `live` may change at any time; the others only while their node is unconfigured,
for a node takes them when it is configured. Every change is checked like a value given at start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from meslam_core.config import MeslamConfig, settings
from meslam_core.errors import ConfigError
from meslam_core.setting import Setting

S = TypeVar("S")
LIVE = "may change at any time"
FIXED = "may change only while the node is unconfigured"


def node_settings(kind: type) -> list[Setting]:
    """The settings of a node's own dataclass; their parameters have no section."""
    return [
        Setting(section="", name=field.name, default=field.default, **field.metadata)
        for field in dataclasses.fields(kind)
    ]


def declare_settings(node: Node, kind: type[S]) -> S:
    """Declare a node's own settings; the object returned follows the parameters.

    Raises:
        ConfigError: when a given value has the wrong type or is out of range.
    """
    entries = {entry.path: entry for entry in node_settings(kind)}
    current = kind(**{entry.name: _declare(node, entry) for entry in entries.values()})

    def follow(changed: Sequence[Parameter]) -> None:
        for parameter in changed:
            if (entry := entries.get(parameter.name)) is not None:
                setattr(current, entry.name, entry.checked(parameter.value))

    _guard(node, entries)
    node.add_post_set_parameters_callback(follow)
    return current


def declare_config(
    node: Node,
    sections: Iterable[str],
    changed: Callable[[MeslamConfig], None] = lambda config: None,
) -> MeslamConfig:
    """Declare `section.name` parameters of the method and return the configuration.

    Args:
        node: to declare on.
        sections: of `MeslamConfig` that the node uses; the rest keep their defaults.
        changed: called with the configuration when parameters of it have changed.

    Raises:
        ConfigError: when a given value has the wrong type or is out of range.
    """
    wanted = set(sections)
    entries = {entry.path: entry for entry in settings() if entry.section in wanted}
    config = _config(entries.values(), lambda entry: _declare(node, entry))

    def follow(parameters: Sequence[Parameter]) -> None:
        if any(parameter.name in entries for parameter in parameters):
            changed(read_config(node))

    _guard(node, entries)
    node.add_post_set_parameters_callback(follow)
    return config


def read_config(node: Node) -> MeslamConfig:
    """The configuration that a node's declared parameters give now.

    Raises:
        ConfigError: when values contradict each other.
    """
    declared = [entry for entry in settings() if node.has_parameter(entry.path)]
    return _config(declared, lambda entry: entry.checked(node.get_parameter(entry.path).value))


def descriptor(entry: Setting) -> ParameterDescriptor:
    """What `ros2 param describe` says about a setting."""
    constraints = f"one of: {', '.join(entry.choices)}; " if entry.choices else ""
    result = ParameterDescriptor(
        name=entry.path,
        description=entry.meaning + (f" [{entry.unit}]" if entry.unit else ""),
        additional_constraints=constraints + (LIVE if entry.live else FIXED),
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


def _config(entries: Iterable[Setting], value_of: Callable[[Setting], Any]) -> MeslamConfig:
    values: dict[str, dict[str, Any]] = {}
    for entry in entries:
        values.setdefault(entry.section, {})[entry.name] = value_of(entry)
    return MeslamConfig.from_mapping(values)


def _guard(node: Node, entries: dict[str, Setting]) -> None:
    """Refuse values that are unusable, or that come when they would no longer be taken."""

    def check(changed: Sequence[Parameter]) -> SetParametersResult:
        for parameter in changed:
            entry = entries.get(parameter.name)
            if entry is None:
                continue
            try:
                entry.checked(parameter.value)
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
            if not entry.live and getattr(node, "configured", True):
                return SetParametersResult(successful=False, reason=_too_late(node, entry))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)


def _too_late(node: Node, entry: Setting) -> str:
    name = node.get_fully_qualified_name()
    return (
        f"{entry.path} cannot change while {name} runs: it is taken when the node is configured. "
        f"Start the node anew with it, or take it through `ros2 lifecycle set {name}` deactivate "
        "and cleanup, set it, then configure and activate"
    )


def _declare(node: Node, entry: Setting) -> int | float | bool | str:
    try:
        value = node.declare_parameter(entry.path, entry.default, descriptor(entry)).value
    except ParameterException as error:
        override = node._parameter_overrides.get(entry.path)
        if override is not None:
            entry.checked(override.value)
        raise ConfigError(f"parameter {entry.path} cannot be used: {error}") from error
    return entry.checked(value)
