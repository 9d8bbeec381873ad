"""The neural field of a region: embedding, network, sampling and volume rendering."""

from __future__ import annotations

import torch

from meslam_core.config import FieldConfig
from meslam_core.field.model import FieldModel, TorchField


def make_field(config: FieldConfig, seed: int) -> FieldModel:
    """A freshly initialised field on the backend that the configuration asks for."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return TorchField(config, seed, device)
