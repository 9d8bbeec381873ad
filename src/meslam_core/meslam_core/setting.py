"""One number of a configuration: its default, unit, range and meaning, and the check of a value."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from meslam_core.errors import ConfigError

# Larger whole numbers may be more than a float holds.
LARGEST_WHOLE = 10**300

T = TypeVar("T", int, float, bool, str)


def setting(
    default: T,
    meaning: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> T:
    """A dataclass field that carries its unit, range and meaning.

    Args:
        default: value, which tells the type too.
        meaning: in a few words, for people.
        unit, minimum, maximum, choices: what a value may be.
        live: whether it may change while it is in use.
    """
    metadata = {
        "meaning": meaning,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
        "live": live,
    }
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Setting:
    """One number of the configuration with everything known about it."""

    section: str
    name: str
    default: int | float | bool | str
    meaning: str
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    live: bool = False

    @property
    def path(self) -> str:
        """`section.name`, as in `--set` and in ROS parameters."""
        return f"{self.section}.{self.name}" if self.section else self.name

    def checked(self, value: Any) -> int | float | bool | str:
        """`value` in the setting's type.

        Raises:
            ConfigError: when the type is wrong or the value out of range.
        """
        kind: Any = type(self.default)
        if kind is float and type(value) is int and abs(value) < LARGEST_WHOLE:
            value = float(value)
        if kind is str and type(value) is int:
            # ROS and YAML read a serial number or a folder named 2024 as a number.
            value = str(value)
        if type(value) is not kind:
            raise ConfigError(
                f"{self.path} = {value!r} is {type(value).__name__}, expected {kind.__name__}"
            )
        if self.choices and value not in self.choices:
            raise ConfigError(f"{self.path} = {value!r}; choose one of {', '.join(self.choices)}")
        if not self._in_range(value):
            raise ConfigError(
                f"{self.path} = {value} is outside [{self.minimum}, {self.maximum}] {self.unit}"
            )
        return cast("int | float | bool | str", value)

    def _in_range(self, value: Any) -> bool:
        """Whether a value keeps the limits; not-a-number keeps none."""
        low = self.minimum is None or value >= self.minimum
        return low and (self.maximum is None or value <= self.maximum)
