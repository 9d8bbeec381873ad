"""The neural field of a region: embedding, network, sampling and volume rendering.

The compiled kernel in here serves odometry too, which needs no torch: so that is imported late.
"""

from __future__ import annotations

import functools
import logging
from typing import TYPE_CHECKING

from meslam_core.config import FieldConfig

if TYPE_CHECKING:
    import torch

    from meslam_core.field.model import FieldModel

log = logging.getLogger(__name__)


def field_device(config: FieldConfig) -> torch.device:
    """Where fields of this configuration are computed: a GPU where torch sees one."""
    import torch

    if config.backend != "kernel" and torch.cuda.is_available():
        return torch.device("cuda")
    return torch.device("cpu")


def make_field(config: FieldConfig, seed: int) -> FieldModel:
    """A freshly initialised field on the backend that the configuration asks for.

    Raises:
        ConfigError: backend is 'kernel' and the compiled kernel cannot serve the configuration.
    """
    from meslam_core.field.kernel import KernelField, unavailable_reason
    from meslam_core.field.model import TorchField

    device = field_device(config)
    if config.backend == "kernel":
        return KernelField(config, seed)
    if config.backend == "auto" and device.type == "cpu":
        reason = unavailable_reason(config)
        if not reason:
            return KernelField(config, seed)
        _say_once(f"{reason}; torch computes the field instead, several times slower")
    return TorchField(config, seed, device)


@functools.cache
def _say_once(message: str) -> None:
    log.warning(message)
