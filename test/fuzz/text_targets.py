"""Fuzzing of texts that people and other programs write: poses, settings, descriptions."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
import typer
import yaml
from data.synthetic_frames import CAMERA, plane_frames
from fuzz.mutation import Parts, mutated_text
from fuzz.target import Target

from meslam_core import se3
from meslam_core.cli import _frame_range
from meslam_core.config import PRESETS, MeslamConfig, OdometryConfig
from meslam_core.continuation import read_start_pose
from meslam_core.errors import ConfigError, EvaluationError
from meslam_core.evaluation.report import trajectory_entries
from meslam_core.frame_log import COLUMNS, read_frame_log
from meslam_core.odometry import GivenOdometry
from meslam_core.pose_covariance import PoseCovariances, read_covariances, write_covariances
from meslam_core.recordings.image_files import CameraFile
from meslam_core.trajectory import Trajectory, read_tum, write_tum

NUMBER = 12


def _poses() -> Trajectory:
    frames = plane_frames(NUMBER)
    poses = [
        se3.exp(np.array([0.05 * n, 0.01 * n * n, 0.0, 0.0, 0.02 * n, 0.1])) for n in range(NUMBER)
    ]
    return Trajectory(np.array([frame.stamp_ns for frame in frames]), np.array(poses))


def _written(write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "file")
        return (Path(folder) / "file").read_bytes()


def _trajectory_seeds() -> list[Parts]:
    data = _written(lambda path: write_tum(path, _poses()))
    return [{"poses.txt": data}, {"poses.txt": data.replace(b" ", b", ")}]


def _file(parts: Parts, folder: Path) -> Path:
    """The only part, written to a file of its name."""
    ((name, data),) = parts.items()
    (folder / name).write_bytes(data)
    return folder / name


def _trajectory(parts: Parts, folder: Path) -> str:
    trajectory = read_tum(_file(parts, folder))
    write_tum(folder / "again.txt", trajectory)
    assert len(read_tum(folder / "again.txt")) == len(trajectory)
    try:
        entries = trajectory_entries(trajectory, _poses())
        assert all(np.isfinite(value) for value in entries.values() if isinstance(value, float))
    except EvaluationError as error:
        return f"{len(trajectory)} {error}"
    return str(len(trajectory))


def _odometry(parts: Parts, folder: Path) -> str:
    odometry = GivenOdometry(read_tum(_file(parts, folder)), OdometryConfig())
    valid = 0
    for frame in plane_frames(NUMBER):
        estimate = odometry.process(frame)
        assert np.isfinite(estimate.T_odom_camera).all()
        assert np.isfinite(estimate.covariance).all()
        valid += estimate.valid
    return str(valid)


def _covariance_seeds() -> list[Parts]:
    matrices = np.tile(np.eye(6) * 1e-4, (3, 1, 1))
    covariances = PoseCovariances(np.arange(3) * 10**9, matrices)
    return [{"covariance.txt": _written(lambda path: write_covariances(path, covariances))}]


def _covariances(parts: Parts, folder: Path) -> str:
    covariances = read_covariances(_file(parts, folder))
    assert np.isfinite(covariances.matrices).all()
    write_covariances(folder / "again.txt", covariances)
    return str(len(covariances))


def _log_seeds() -> list[Parts]:
    lines = [",".join(COLUMNS)]
    for number in range(3):
        values = [f"{number}.5", "OK", "", *("0.25" for _ in COLUMNS[3:])]
        lines.append(",".join(values))
    return [{"frames.txt": ("\n".join(lines) + "\n").encode()}]


def _log(parts: Parts, folder: Path) -> str:
    table = read_frame_log(_file(parts, folder))
    assert len(table.states) == len(table.reasons) == len(table)
    known = [name for name in table.numbers if table.known(name)]
    return f"{len(table)} {len(known)}"


def _text(parts: Parts) -> str:
    """As an operating system gives what is no UTF-8."""
    (data,) = parts.values()
    return data.decode("utf-8", "surrogateescape")


def _start_pose(parts: Parts, folder: Path) -> str:
    pose = read_start_pose(_text(parts))
    assert np.isfinite(pose).all()
    return "pose"


def _overrides(parts: Parts, folder: Path) -> str:
    preset, *overrides = _text(parts).split("\n")
    config = MeslamConfig.from_overrides(overrides, preset)
    assert MeslamConfig.from_mapping(config.to_mapping()) == config
    return "configuration"


def _override_seeds() -> list[Parts]:
    texts = [
        "default\nfield.width=64\ntracking.iterations=3",
        "fine\nmap.codec=fp16\nfield.embedding_sigma=3e1",
    ]
    texts += ["default\nodometry.method=none\nregions.single=true\nruntime.work_dir=2024"]
    return [{"overrides.txt": text.encode()} for text in texts]


def _mutated_overrides(parts: Parts, others: list[Parts], rng: Random) -> Parts:
    """Mostly one setting that exists with an odd value."""
    data = parts["overrides.txt"]
    if rng.random() < 0.5:
        known = MeslamConfig().to_mapping()
        section = rng.choice(sorted(known))
        name = rng.choice(sorted(known[section]))
        lines = [*data.split(b"\n"), f"{section}.{name}={known[section][name]}".encode()]
        data = b"\n".join([rng.choice(sorted(PRESETS)).encode(), *lines[-2:]])
    return {"overrides.txt": mutated_text(data, rng.choice(others)["overrides.txt"], rng)}


def _yaml_seeds() -> list[Parts]:
    return [{"settings.yaml": yaml.safe_dump(MeslamConfig().to_mapping()).encode()}]


def _yaml(parts: Parts, folder: Path) -> str:
    try:
        values = yaml.safe_load(parts["settings.yaml"])
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(str(error)) from error
    if not isinstance(values, dict):
        raise ConfigError("no mapping")
    MeslamConfig.from_mapping(values)
    return "configuration"


def _frames(parts: Parts, folder: Path) -> str:
    chosen = _frame_range(_text(parts))
    return str(len(range(100)[chosen]))


def _camera_seeds() -> list[Parts]:
    import json

    plain = CAMERA.to_dict()
    full = plain | {"depth_scale_m": 0.0002, "fps": 30, "depth_aligned_to_color": True}
    return [{"camera.json": json.dumps(values).encode()} for values in (plain, full)]


def _camera(parts: Parts, folder: Path) -> str:
    described = CameraFile.read(_file(parts, folder))
    assert np.isfinite(described.camera.matrix).all()
    described.camera.scaled(0.5)
    return f"{described.fps} {described.depth_scale_m}"


def _lines(*texts: str) -> Callable[[], list[Parts]]:
    return lambda: [{"text.txt": text.encode()} for text in texts]


TARGETS = [
    Target("trajectory", "poses in TUM format, evaluated", _trajectory_seeds, _trajectory),
    Target("odometry file", "odometry in TUM format, asked", _trajectory_seeds, _odometry),
    Target("covariances", "covariances of poses", _covariance_seeds, _covariances),
    Target("frame log", "frames.csv of a run", _log_seeds, _log),
    Target(
        "start pose",
        "`--start-pose`, `map_start_pose`",
        _lines("0 0 0 0 0 0 1", "1.5, -2, 0.1, 0.5, 0.5, 0.5, 0.5"),
        _start_pose,
    ),
    Target("settings", "`--preset` and `--set`", _override_seeds, _overrides, _mutated_overrides),
    Target("settings file", "settings as nested YAML", _yaml_seeds, _yaml),
    Target(
        "frame range",
        "`--frames`",
        _lines(":", "0:100", "3:90:2"),
        _frames,
        refusals=(typer.BadParameter,),
    ),
    Target("camera.json", "a description of a camera", _camera_seeds, _camera),
]
