"""Every parser that is fuzzed, by name."""

from __future__ import annotations

from fuzz import map_targets, message_targets, recording_targets, run_targets, text_targets
from fuzz.target import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (map_targets, text_targets, run_targets, recording_targets, message_targets)
    for target in module.TARGETS
}
