"""A simulated recording: a hand-held D435 in a textured scene, with exact truth."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from meslam_core.camera import PinholeCamera
from meslam_core.errors import ConfigError, RecordingError
from meslam_core.frame import RgbdFrame
from meslam_core.simulation.path import HandheldPath
from meslam_core.simulation.renderer import Renderer, View
from meslam_core.simulation.scene import Scene
from meslam_core.simulation.scenes import build_scene
from meslam_core.simulation.sensor import D435, D435_CAMERA
from meslam_core.trajectory import NANOSECONDS, Trajectory

START_NS = 1_600_000_000 * NANOSECONDS
"""Stamp of the first frame of every simulation [ns]."""

BLUR_VIEWS = 7
RENDER_THREADS = 2


class Simulation:
    """A recording (see `recordings.Recording`) that is rendered while it is read.

    Frames depend on nothing but the arguments of `simulate` and their index.

    Attributes:
        name, path, format, topics, camera, stamps_ns: as every recording has.
        fps: frames a second.
        truth: T_scene_camera of every frame; the scene's z axis points up.
        surface: the exact surface in the scene's frame [m].
    """

    def __init__(
        self,
        scene: Scene,
        renderer: Renderer,
        truth: Trajectory,
        path: HandheldPath,
        camera: PinholeCamera,
        *,
        seed: int,
        fps: float,
        noise: bool,
        motion_blur_s: float,
    ) -> None:
        self.name = f"simulation {scene.name}, seed {seed}"
        self.path = Path(f"{scene.name}.simulation")
        self.format = "simulation"
        self.topics: dict[str, str] = {}
        self.camera = camera
        self.fps = fps
        self.truth = truth
        self.surface: o3d.geometry.TriangleMesh = renderer.surface
        self._renderer = renderer
        self._path = path
        self._seed = seed
        self._sensor = D435() if noise else None
        self._distortion = D435().distortion(camera, seed)
        self._motion_blur_s = motion_blur_s

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of all frames [ns], shape (len,)."""
        return self.truth.stamps_ns

    def __len__(self) -> int:
        return len(self.truth)

    def frames(self, start: int = 0, stop: int | None = None, step: int = 1) -> Iterator[RgbdFrame]:
        """Render the frames `start:stop:step` in order, two at a time and two ahead."""
        indices = iter(range(len(self))[start:stop:step])
        with ThreadPoolExecutor(RENDER_THREADS) as pool:
            ahead = islice(indices, 2 * RENDER_THREADS)
            pending = deque(pool.submit(self.frame, i) for i in ahead)
            while pending:
                frame = pending.popleft().result()
                pending.extend(pool.submit(self.frame, i) for i in islice(indices, 1))
                yield frame

    def frame(self, index: int) -> RgbdFrame:
        """Render one frame.

        Raises:
            RecordingError: when there is no such frame.
        """
        if not 0 <= index < len(self):
            raise RecordingError(f"{self.name} has {len(self)} frames, there is no frame {index}")
        view = self.ideal_view(index)
        stamp = int(self.truth.stamps_ns[index])
        if self._sensor is None:
            color = np.clip(view.color + 0.5, 0, 255).astype(np.uint8)
            return RgbdFrame(stamp, color, view.depth_m, self.camera)
        rng = np.random.default_rng((self._seed, index))
        exposure = self._sensor.exposure(index / self.fps, self._seed)
        return RgbdFrame(
            stamp_ns=stamp,
            color=self._sensor.color(view, rng, exposure),
            depth_m=self._sensor.depth(view, self.camera, self._distortion, rng),
            camera=self.camera,
        )

    def ideal_view(self, index: int) -> View:
        """The view of frame `index` without the sensor's noise, with motion blur if asked for."""
        view = self._renderer.render(self.camera, self.truth.poses[index])
        if self._motion_blur_s <= 0:
            return view
        shifts = (np.arange(BLUR_VIEWS) / (BLUR_VIEWS - 1) - 0.5) * self._motion_blur_s
        times = index / self.fps + shifts
        views = [self._renderer.render(self.camera, self._path.pose(time)) for time in times]
        color = np.stack([blurred.color for blurred in views]).mean(axis=0)
        return View(color, view.depth_m, view.incidence)

    def close(self) -> None:
        """Nothing to release."""


def simulate(
    scene: str,
    duration_s: float | None = None,
    seed: int = 0,
    camera: PinholeCamera | None = None,
    fps: float = 15.0,
    noise: bool = True,
    motion_blur_s: float = 0.0,
) -> Simulation:
    """Prepare a simulated recording; the frames are rendered when they are read.

    Args:
        scene: a name of `scenes.SCENES`; the same name is always the same space.
        duration_s: length of the recording [s]; None for one round of the scene's route.
        seed: of the path, the sensor's noise and the exposure.
        camera: intrinsics; None for a D435's at 640x480.
        fps: frames a second.
        noise: whether the sensor has errors; without, depth is exact and unlimited.
        motion_blur_s: exposure time during which the image smears [s]; 0 for none.

    Raises:
        ConfigError: for an unknown scene, or a duration or rate that is not positive.
    """
    if motion_blur_s < 0 or seed < 0:
        raise ConfigError(
            f"motion_blur_s is {motion_blur_s} and seed {seed}; neither may be negative"
        )
    built = _scene(scene)
    duration_s = built.route.round_s if duration_s is None else duration_s
    if not (duration_s > 0 and fps > 0 and np.isfinite(duration_s * fps)):
        raise ConfigError(
            f"a simulation of {duration_s} s at {fps} frames/s has no frames; both must be positive"
        )
    camera = camera or D435_CAMERA
    # Finer texels than a pixel at half a metre are wasted on a small camera.
    texel_scale = max(1.0, float(2 ** round(np.log2(D435_CAMERA.fx / camera.fx))))
    path = HandheldPath(built.route, duration_s, seed)
    indices = np.arange(max(1, round(duration_s * fps)))
    truth = Trajectory(
        stamps_ns=START_NS + np.round(indices * (NANOSECONDS / fps)).astype(np.int64),
        poses=np.stack([path.pose(index / fps) for index in indices]),
    )
    return Simulation(
        built,
        _renderer(scene, texel_scale),
        truth,
        path,
        camera,
        seed=seed,
        fps=fps,
        noise=noise,
        motion_blur_s=motion_blur_s,
    )


@lru_cache(maxsize=4)
def _scene(name: str) -> Scene:
    return build_scene(name)


@lru_cache(maxsize=2)
def _renderer(scene: str, texel_scale: float) -> Renderer:
    """A scene with its textures baked; the costly part, shared by simulations of one process."""
    return Renderer(_scene(scene), texel_scale)
