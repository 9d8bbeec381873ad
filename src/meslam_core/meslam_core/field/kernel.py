"""The compiled field kernel: the network of `network.py`, fused, on one or more CPU cores.

One pass over blocks of samples that stay in cache computes embedding, layers and outputs; on the
way back the gradients of weights, embedding and points together. Which instructions it uses is
found at run time; the environment variable MESLAM_KERNEL_ISA caps the choice.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from meslam_core.config import FieldConfig, MappingConfig
from meslam_core.errors import ConfigError
from meslam_core.field.alignment import AlignmentSettings, NormalEquations
from meslam_core.field.model import ADAM_BETAS, ADAM_EPSILON, AVERAGE_SHARE
from meslam_core.field.network import FieldNetwork
from meslam_core.field.rendering import surface_offset_m

_import_error = ""
try:
    from meslam_core.field import _kernel
except ImportError as error:
    _import_error = str(error)

Floats = NDArray[np.float32]

WIDTHS = (64, 128, 256)
EMBEDDING_MULTIPLE = 32


def unavailable_reason(config: FieldConfig | None = None) -> str:
    """Why the kernel cannot be used, for people; empty where it can.

    Args:
        config: of the field that it should compute; None asks about the extension alone.
    """
    if _import_error:
        return f"the compiled field kernel is not installed ({_import_error})"
    if config is None:
        return ""
    if config.width not in WIDTHS:
        return f"the compiled field kernel has widths {WIDTHS}, not {config.width}"
    if config.embedding % EMBEDDING_MULTIPLE:
        return (
            f"the compiled field kernel takes embeddings in multiples of {EMBEDDING_MULTIPLE}, "
            f"not {config.embedding}"
        )
    return ""


def available_isas() -> tuple[str, ...]:
    """Instruction sets usable here, the best first; empty without the extension.

    Raises:
        ConfigError: MESLAM_KERNEL_ISA names none that exists.
    """
    if _import_error:
        return ()
    try:
        return tuple(_kernel.available_isas())
    except ValueError as error:
        raise ConfigError(str(error)) from error


def sample_rays(distances_m: Floats, mapping: MappingConfig, seed: int) -> Floats:
    """Ascending distances (R, S) along rays, distributed as `sampling.sample_distances` has them.

    Args:
        distances_m: (R,) of the measured surface along the ray.
        mapping: numbers of samples and their spread.
        seed: of the random numbers; a ray's depend on it and on the ray's number alone.
    """
    return _kernel.sample_rays(_sampling_settings(mapping), seed, distances_m)


def _sampling_settings(mapping: MappingConfig) -> _kernel.SamplingSettings:
    return _kernel.SamplingSettings(
        free_samples=mapping.free_samples,
        surface_samples=mapping.surface_samples,
        surface_sigma=mapping.surface_sigma_m,
    )


def _ray_settings(config: FieldConfig, mapping: MappingConfig) -> _kernel.RaySettings:
    return _kernel.RaySettings(
        density_scale=config.density_scale,
        truncation=config.truncation_m,
        surface_offset=surface_offset_m(config),
        distance_weight=mapping.distance_weight,
        depth_weight=mapping.depth_weight,
        color_weight=mapping.color_weight,
        depth_clip=mapping.depth_clip_m,
    )


class KernelField:
    """`FieldModel` on the compiled kernel.

    Args:
        config: width 64, 128 or 256; embedding a multiple of 32.
        seed: of the initial weights, the same that `FieldNetwork` draws.
        isa: 'auto' (the best there is) or one of `available_isas`.
        threads: of this field alone; its calls from several threads follow one another.

    Raises:
        ConfigError: the extension is missing, or has no code for the sizes or instruction set.
    """

    def __init__(
        self, config: FieldConfig, seed: int = 0, isa: str = "auto", threads: int = 1
    ) -> None:
        reason = unavailable_reason(config)
        if reason:
            raise ConfigError(f"{reason}; set field.backend to 'torch'")
        self.config = config
        self.device = torch.device("cpu")
        try:
            self.fused = _kernel.FusedField(config.width, config.embedding, isa, threads)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self.fused.set_parameters(FieldNetwork(config, seed).flat())

    def evaluate(self, points: torch.Tensor) -> torch.Tensor:
        """Values (N, 4) at points (N, 3); backward adds to the field's own gradients."""
        anchor = torch.empty(0, requires_grad=True)
        values: torch.Tensor = _Evaluation.apply(points, anchor, self.fused)  # type: ignore[no-untyped-call]
        return values

    def step(self, learning_rate: float) -> bool:
        """One Adam step with the gradients since the last; False (and no step) if not finite."""
        return self.fused.adam_step(
            learning_rate, *ADAM_BETAS, ADAM_EPSILON, average_share=AVERAGE_SHARE
        )

    def predict(self, points: Floats) -> Floats:
        """Values (N, 4) at points (N, 3) without gradients."""
        return self.fused.forward(np.ascontiguousarray(points, dtype=np.float32))

    def probe(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Values (N, 4), df/dpoint (N, 3) and dluma/dpoint (N, 3), for tracking."""
        values, distance, luma = self.fused.forward_with_gradient(
            np.ascontiguousarray(points, dtype=np.float32)
        )
        assert luma is not None
        return values, distance, luma

    def train_rays(
        self,
        origins: Floats,
        directions: Floats,
        distances_m: Floats,
        colors: Floats,
        along_m: Floats,
        mapping: MappingConfig,
        weights: Floats | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """Samples, values, rendering, `mapping.losses.ray_losses` and the way back in one pass.

        Adds the gradients of the mean loss over the rays to the field's own; `step` uses them.

        Args:
            origins: (R, 3) region coordinates.
            directions: (R, 3) change of region coordinates along the ray [1/m].
            distances_m: (R,) of the measured surface along the ray.
            colors: (R, 3) measured, in [0, 1].
            along_m: (R, S) ascending distances of the samples along the ray.
            mapping: weights of the losses.
            weights: (R,) factors on the rays' losses; ones by default.

        Returns:
            Weighted losses (R, 3): signed distance, rendered depth, rendered colour, before the
            rays' own weights; and the gradients (R, 3) of the mean by origins and by directions.
        """
        return self.fused.train_rays(
            _ray_settings(self.config, mapping),
            origins,
            directions,
            distances_m,
            colors,
            along_m,
            weights,
        )

    def train_posed_rays(
        self,
        rotations: Floats,
        translations: Floats,
        pose: NDArray[np.int64],
        directions: Floats,
        distances_m: Floats,
        colors: Floats,
        to_region: Floats,
        mapping: MappingConfig,
        seed: int,
        weights: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """`train_rays` of rays in their cameras' frames, at samples drawn by `sample_rays`.

        Args:
            rotations, translations: (P, 3, 3) and (P, 3) T_map_camera of the cameras [m].
            pose: (R,) int64, number of each ray's camera.
            directions: (R, 3) unit vectors, camera frame.
            distances_m: (R,) of the measured surface along the ray.
            colors: (R, 3) measured, in [0, 1].
            to_region: (3, 4) from the map frame [m] to region coordinates.
            mapping: numbers of samples, weights of the losses.
            seed: of the samples; another one for every step.
            weights: (R,) factors on the rays' losses; ones by default.

        Returns:
            Weighted losses (R, 3) as `train_rays` has them; and the gradients (P, 6) of the mean
            by small moves (translation [m], rotation [rad]) of the cameras about their centres,
            map axes.
        """
        return self.fused.train_posed_rays(
            _ray_settings(self.config, mapping),
            _sampling_settings(mapping),
            seed,
            rotations,
            translations,
            pose,
            directions,
            distances_m,
            colors,
            to_region,
            weights,
        )

    def normal_equations(
        self,
        points: Floats,
        arms_m: Floats,
        luma: Floats,
        weights: Floats,
        settings: AlignmentSettings,
    ) -> NormalEquations:
        """Gauss-Newton's equations of measured surface points against the field.

        Args:
            points: (N, 3) region coordinates.
            arms_m: (N, 3) from the camera centre to the points, map axes.
            luma: (N,) measured at the points.
            weights: (N,); a point with weight 0 is not used.
            settings: of the residuals.
        """
        return NormalEquations(
            *self.fused.normal_equations(
                points,
                arms_m,
                luma,
                weights,
                to_map=settings.to_map,
                surface_level=settings.surface_level,
                saturation=settings.saturation,
                min_slope=settings.min_slope,
                huber=settings.huber_m,
                color_weight=settings.color_weight,
            )
        )

    def flat(self) -> Floats:
        """Copy of the weights in the layout of `network.parameter_shapes`."""
        return self.fused.parameters()

    def average(self) -> Floats:
        """Copy of the weights averaged over the last steps, in the layout of `flat`."""
        return self.fused.average()

    def load_flat(self, vector: Floats) -> None:
        """Replace the weights and forget the optimiser's state.

        Raises:
            ValueError: the vector has another length or numbers that are not finite.
        """
        self.fused.set_parameters(np.ascontiguousarray(vector, dtype=np.float32))
        self.fused.zero_gradients()
        self.fused.reset_optimizer()

    def optimizer_state(self) -> tuple[Floats, Floats, int]:
        """Adam's first and second moments in the layout of `flat`, and its number of steps."""
        return self.fused.optimizer_state()

    def load_optimizer_state(self, first: Floats, second: Floats, step: int) -> None:
        """Go on where an optimiser was that had this state.

        Raises:
            ValueError: the moments have another length or numbers that are not finite.
        """
        self.fused.set_optimizer_state(
            np.ascontiguousarray(first, np.float32), np.ascontiguousarray(second, np.float32), step
        )


class _Evaluation(torch.autograd.Function):
    """Lets torch's graph end in the kernel.

    The weights are no tensors: an empty `anchor` that requires a gradient makes torch call
    backward also where the points require none.
    """

    @staticmethod
    def forward(
        ctx: Any, points: torch.Tensor, anchor: torch.Tensor, fused: _kernel.FusedField
    ) -> torch.Tensor:
        inputs = points.detach().contiguous().numpy()
        ctx.inputs, ctx.fused = inputs, fused
        return torch.from_numpy(fused.forward(inputs))

    @staticmethod
    def backward(ctx: Any, grad_values: torch.Tensor) -> tuple[torch.Tensor | None, None, None]:
        gradient = ctx.fused.backward(
            ctx.inputs, grad_values.contiguous().numpy(), ctx.needs_input_grad[0]
        )
        return (None if gradient is None else torch.from_numpy(gradient)), None, None
