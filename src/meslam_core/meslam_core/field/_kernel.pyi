from typing import Any

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float32]
_Doubles = NDArray[np.float64]

def available_isas() -> list[str]: ...

class RaySettings:
    def __init__(
        self,
        *,
        density_scale: float,
        truncation: float,
        surface_offset: float,
        distance_weight: float,
        depth_weight: float,
        color_weight: float,
        depth_clip: float,
    ) -> None: ...

class SamplingSettings:
    def __init__(
        self, *, free_samples: int, surface_samples: int, surface_sigma: float
    ) -> None: ...

def sample_rays(settings: SamplingSettings, seed: int, distances: _Floats) -> _Floats: ...

class FusedField:
    def __init__(self, width: int, embedding: int, isa: str = "auto", threads: int = 1) -> None: ...
    @property
    def width(self) -> int: ...
    @property
    def embedding(self) -> int: ...
    @property
    def isa(self) -> str: ...
    @property
    def threads(self) -> int: ...
    @property
    def parameter_count(self) -> int: ...
    def parameters(self) -> _Floats: ...
    def average(self) -> _Floats: ...
    def set_parameters(self, parameters: _Floats) -> None: ...
    def gradients(self) -> _Floats: ...
    def zero_gradients(self) -> None: ...
    def optimizer_state(self) -> tuple[_Floats, _Floats, int]: ...
    def set_optimizer_state(
        self, first_moment: _Floats, second_moment: _Floats, step: int
    ) -> None: ...
    def reset_optimizer(self) -> None: ...
    def forward(self, points: _Floats) -> _Floats: ...
    def forward_with_gradient(
        self, points: _Floats, luma: bool = True
    ) -> tuple[_Floats, _Floats, _Floats | None]: ...
    def backward(
        self, points: _Floats, grad_values: _Floats, want_points: bool = True
    ) -> _Floats | None: ...
    def adam_step(
        self,
        learning_rate: float,
        beta1: float = 0.9,
        beta2: float = 0.99,
        epsilon: float = 1e-8,
        encoding_scale: float = 1.0,
        average_share: float = 1.0,
    ) -> bool: ...
    def train_rays(
        self,
        settings: RaySettings,
        origins: _Floats,
        directions: _Floats,
        distances: _Floats,
        colors: _Floats,
        along: _Floats,
        weights: _Floats | None = None,
    ) -> tuple[_Floats, _Floats, _Floats]: ...
    def train_posed_rays(
        self,
        settings: RaySettings,
        sampling: SamplingSettings,
        seed: int,
        rotations: _Floats,
        translations: _Floats,
        pose: NDArray[np.int64],
        directions: _Floats,
        distances: _Floats,
        colors: _Floats,
        to_region: _Floats,
        weights: _Floats | None = None,
    ) -> tuple[_Floats, _Floats]: ...
    def normal_equations(
        self,
        points: _Floats,
        arms: _Floats,
        luma: _Floats,
        weights: _Floats,
        *,
        to_map: _Doubles,
        surface_level: float,
        saturation: float,
        min_slope: float,
        huber: float,
        color_weight: float,
    ) -> tuple[_Doubles, _Doubles, _Floats, NDArray[np.bool_]]: ...

class RgbdPyramid:
    def __init__(
        self,
        gray: NDArray[np.uint8],
        depth: _Floats,
        *,
        min_depth: float,
        max_depth: float,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        halvings: int,
        levels: int,
    ) -> None: ...
    @property
    def levels(self) -> int: ...
    @property
    def measured(self) -> int: ...

def align_rgbd(
    source: RgbdPyramid,
    target: RgbdPyramid,
    T_target_source: _Doubles,
    *,
    finest: int,
    levels: int,
    iterations: int,
    max_distance: float,
    convergence: float,
    correlated: float,
    luma_bias_m: float,
    luma_bias_rad: float,
) -> dict[str, Any]: ...
def shade(
    image: NDArray[np.uint8],
    levels: _Floats,
    texels: _Floats,
    distance: _Floats,
    triangle: NDArray[np.uint32],
    shares: _Floats,
    cosine: _Floats,
    focal_px: float,
) -> _Floats: ...
def seen_triangles(
    corners: _Doubles,
    *,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> tuple[_Floats, NDArray[np.uint32], _Floats, _Floats]: ...
