"""The settings of runs, and which of them are not the defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from meslam_core.config import settings
from meslam_core.report.run_folder import RunFolder
from meslam_core.setting import Setting


@dataclass(frozen=True)
class SettingLine:
    """A setting of all runs.

    Attributes:
        setting: of the configuration.
        default: as text.
        cells: texts, one a run; empty where it does not tell.
        changed: which of them are not the default.
    """

    setting: Setting
    default: str
    cells: list[str]
    changed: list[bool]


def setting_lines(runs: Sequence[RunFolder]) -> dict[str, list[SettingLine]]:
    """All settings by section; none where no run tells its configuration."""
    configurations = [run.entries.get("config") for run in runs]
    if not any(isinstance(each, Mapping) for each in configurations):
        return {}
    sections: dict[str, list[SettingLine]] = {}
    for setting in settings():
        values = [_value(each, setting) for each in configurations]
        line = SettingLine(
            setting,
            _text(setting.default),
            [_text(value) for value in values],
            [value is not None and value != setting.default for value in values],
        )
        sections.setdefault(setting.section, []).append(line)
    return sections


def _value(configuration: Any, setting: Setting) -> Any:
    section = configuration.get(setting.section) if isinstance(configuration, Mapping) else None
    return section.get(setting.name) if isinstance(section, Mapping) else None


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)
