"""All numbers of the system: defaults, units, ranges and meanings stand here and nowhere else.

The YAML parameter files, the ROS parameter descriptors and `docs/parameters.md` are generated
from these classes (`meslam_core.config_reference`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from meslam_core.errors import ConfigError
from meslam_core.setting import Setting, setting


@dataclass(frozen=True)
class SensorConfig:
    """What of a depth image is believed."""

    min_depth_m: float = setting(
        0.2, "nearer measurements are ignored", unit="m", minimum=0.01, maximum=5.0
    )
    max_depth_m: float = setting(
        5.0, "farther measurements are ignored", unit="m", minimum=0.3, maximum=30.0
    )
    edge_threshold: float = setting(
        0.05,
        "pixels whose depth differs from a neighbour's by more than this share are edges",
        minimum=0.005,
        maximum=1.0,
    )


@dataclass(frozen=True)
class OdometryConfig:
    """Frame-to-keyframe odometry (Sec. II-A)."""

    method: str = setting(
        "direct",
        "'direct': compiled alignment with photometric and geometric terms; "
        "'hybrid': Open3D's RGB-D odometry with both; "
        "'colored_icp': coloured point-cloud registration as in the paper; "
        "'none': no odometry, tracking continues the last motion",
        choices=("direct", "hybrid", "colored_icp", "none"),
    )
    image_width: int = setting(
        320, "images are reduced to at most this width", unit="px", minimum=80, maximum=1920
    )
    voxel_size_m: float = setting(
        0.05, "point spacing of coloured registration", unit="m", minimum=0.005, maximum=0.5
    )
    max_distance_m: float = setting(
        0.07, "correspondences farther apart are outliers", unit="m", minimum=0.005, maximum=1.0
    )
    luma_bias_m: float = setting(
        0.005,
        "what the images alone may tell wrong: colour and depth differ in time",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    luma_bias_deg: float = setting(
        0.25, "the same of the rotation", unit="deg", minimum=0.0, maximum=90.0
    )
    keyframe_translation_m: float = setting(
        0.15, "a new odometry keyframe after this motion", unit="m", minimum=0.01, maximum=2.0
    )
    keyframe_rotation_deg: float = setting(
        12.0, "a new odometry keyframe after this rotation", unit="deg", minimum=0.5, maximum=90.0
    )
    min_fitness: float = setting(
        0.4,
        "share of points with a correspondence below which a result is invalid",
        minimum=0.0,
        maximum=1.0,
    )
    good_fitness: float = setting(
        0.65,
        "share of points with a correspondence below which registration tries harder",
        minimum=0.0,
        maximum=1.0,
    )
    min_agreement: float = setting(
        0.35,
        "share of points that match in depth and colour below which a result is invalid",
        minimum=0.0,
        maximum=1.0,
    )
    max_speed_m_s: float = setting(
        3.0, "faster motion is not believed", unit="m/s", minimum=0.1, maximum=50.0
    )
    max_turn_deg_s: float = setting(
        300.0, "faster turning is not believed", unit="deg/s", minimum=10.0, maximum=3000.0
    )
    given_sigma_m: float = setting(
        0.002,
        "error of odometry from elsewhere (wheels, a tracking camera) from frame to frame",
        unit="m",
        minimum=1e-5,
        maximum=1.0,
    )
    given_sigma_deg: float = setting(
        0.1, "the same of the rotation", unit="deg", minimum=1e-4, maximum=45.0
    )
    given_drift: float = setting(
        0.02,
        "further error of odometry from elsewhere, as a share of the motion",
        minimum=0.0,
        maximum=1.0,
    )
    given_drift_deg_m: float = setting(
        1.0,
        "further error of its rotation with the distance travelled",
        unit="deg/m",
        minimum=0.0,
        maximum=90.0,
    )
    given_gap_s: float = setting(
        0.2,
        "its poses are not interpolated between two that are farther apart",
        unit="s",
        minimum=0.001,
        maximum=60.0,
    )


@dataclass(frozen=True)
class FieldConfig:
    """Architecture of a region's network (Sec. II-B) and how density follows from it."""

    width: int = setting(64, "units of a hidden layer: 64, 128 or 256", minimum=16, maximum=512)
    embedding: int = setting(
        96, "sine features of the Gaussian positional embedding", minimum=8, maximum=512
    )
    embedding_sigma: float = setting(
        9.0,
        "standard deviation of the embedding's frequencies, region coordinates",
        minimum=0.5,
        maximum=1000.0,
    )
    density_scale: float = setting(
        500.0,
        "density is this times the positive part of the first output",
        unit="1/m",
        minimum=10.0,
        maximum=10000.0,
    )
    truncation_m: float = setting(
        0.10, "distance at which the signed distance saturates", unit="m", minimum=0.01, maximum=1.0
    )
    backend: str = setting(
        "auto",
        "'kernel': compiled field kernel on the CPU; 'torch': reference; 'auto': GPU, else kernel",
        choices=("auto", "kernel", "torch"),
    )


@dataclass(frozen=True)
class TrackingConfig:
    """Pose of a frame by Gauss-Newton on the field."""

    points: int = setting(1500, "pixels used for one pose", minimum=100, maximum=50000)
    iterations: int = setting(10, "at most this many steps", minimum=1, maximum=100)
    convergence: float = setting(
        3e-4, "a step smaller than this ends the search", unit="m", minimum=1e-6, maximum=0.01
    )
    huber_wide_m: float = setting(
        0.08, "robust threshold of the first step", unit="m", minimum=0.001, maximum=1.0
    )
    huber_narrow_m: float = setting(
        0.02, "robust threshold of the last step", unit="m", minimum=0.001, maximum=1.0
    )
    color_weight: float = setting(
        0.15, "weight of the colour residual (0 switches it off)", minimum=0.0, maximum=10.0
    )
    points_per_observation: float = setting(
        1500.0,
        "points that err together, and count as one observation against odometry",
        minimum=1.0,
        maximum=100000.0,
    )
    odometry_sigma_m: float = setting(
        0.001, "error of odometry from frame to frame", unit="m", minimum=1e-5, maximum=1.0
    )
    odometry_sigma_deg: float = setting(
        0.05,
        "error of odometry's rotation from frame to frame",
        unit="deg",
        minimum=1e-4,
        maximum=45.0,
    )
    odometry_drift: float = setting(
        0.01, "further error of odometry, as a share of the motion", minimum=0.0, maximum=1.0
    )
    min_inlier_ratio: float = setting(
        0.35, "share of inliers below which a pose is not trusted", minimum=0.0, maximum=1.0
    )
    min_observed_ratio: float = setting(
        0.2,
        "share of a frame's points in mapped space below which odometry alone decides",
        minimum=0.0,
        maximum=1.0,
    )
    inlier_distance_m: float = setting(
        0.05, "a point this near to the surface is an inlier", unit="m", minimum=0.002, maximum=0.5
    )
    max_residual_m: float = setting(
        0.04,
        "median residual above which a pose is not trusted",
        unit="m",
        minimum=0.001,
        maximum=0.5,
    )
    lost_after_frames: int = setting(
        10, "untrusted poses in a row after which tracking is lost", minimum=1, maximum=1000
    )
    max_speed_m_s: float = setting(
        3.0, "faster motion is not believed", unit="m/s", minimum=0.1, maximum=50.0
    )
    max_turn_deg_s: float = setting(
        300.0, "faster turning is not believed", unit="deg/s", minimum=10.0, maximum=3000.0
    )
    max_conflict_m: float = setting(
        0.15,
        "a pose farther from where odometry has it is not trusted",
        unit="m",
        minimum=0.01,
        maximum=10.0,
    )
    max_conflict_deg: float = setting(
        10.0,
        "a pose turned farther from where odometry has it is not trusted",
        unit="deg",
        minimum=0.5,
        maximum=180.0,
    )
    certain_inlier_ratio: float = setting(
        0.9,
        "share of inliers from which on the map alone tells the pose where odometry has failed",
        minimum=0.0,
        maximum=1.0,
    )
    certain_colour_likeness: float = setting(
        0.5, "correlation of measured and mapped luma that it takes", minimum=-1.0, maximum=1.0
    )
    doubted_inlier_ratio: float = setting(
        0.5,
        "share of inliers below which a pose is not trusted where odometry does not support it",
        minimum=0.0,
        maximum=1.0,
    )
    doubted_colour_likeness: float = setting(
        0.4,
        "correlation of measured and mapped luma below which a pose is not trusted where odometry "
        "does not support it",
        minimum=-1.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class RelocalisationConfig:
    """How a camera that was lost is found again in the map."""

    keyframes: int = setting(
        1000, "keyframes whose looks are remembered, 4.4 kB each", minimum=1, maximum=100000
    )
    candidates: int = setting(
        2, "keyframes that a lost frame is compared with", minimum=0, maximum=100
    )
    min_fitness: float = setting(
        0.5,
        "share of a frame's points that must have a match in a keyframe's depth",
        minimum=0.0,
        maximum=1.0,
    )
    min_image_likeness: float = setting(
        0.8, "share of those that must look alike, too", minimum=0.0, maximum=1.0
    )
    min_observed_ratio: float = setting(
        0.5, "share of a frame's points that must lie in mapped space", minimum=0.0, maximum=1.0
    )
    min_inlier_ratio: float = setting(
        0.7, "share of those that must lie on the map", minimum=0.0, maximum=1.0
    )
    max_residual_m: float = setting(
        0.03, "median distance to the map at most", unit="m", minimum=0.001, maximum=0.5
    )
    min_colour_likeness: float = setting(
        0.5, "correlation of measured and mapped luma at least", minimum=-1.0, maximum=1.0
    )
    agreement_m: float = setting(
        0.05,
        "two frames in a row must tell the same place within this",
        unit="m",
        minimum=0.001,
        maximum=1.0,
    )
    agreement_deg: float = setting(
        3.0, "the same of the direction", unit="deg", minimum=0.1, maximum=90.0
    )
    new_map_after_s: float = setting(
        0.0,
        "a node that has looked for a lost camera in vain for so long begins a new map, which is "
        "not connected with the old one (0: never)",
        unit="s",
        minimum=0.0,
        maximum=86400.0,
    )


@dataclass(frozen=True)
class KeyframesConfig:
    """When a frame becomes a keyframe and what is kept of it."""

    agreement: float = setting(
        0.65,
        "a frame becomes a keyframe when less than this share of its pixels agrees with the "
        "rendered depth (iMAP)",
        minimum=0.0,
        maximum=1.0,
    )
    agreement_tolerance: float = setting(
        0.1, "relative depth error up to which a pixel agrees", minimum=0.001, maximum=1.0
    )
    translation_m: float = setting(
        0.10, "or when it moved this far from its reference", unit="m", minimum=0.01, maximum=5.0
    )
    rotation_deg: float = setting(
        8.0, "or turned this much", unit="deg", minimum=0.5, maximum=180.0
    )
    overlap: float = setting(
        0.75,
        "or when less than this share of its points projects into its reference",
        minimum=0.0,
        maximum=1.0,
    )
    rays: int = setting(8192, "pixels kept of a keyframe for training", minimum=256, maximum=200000)
    ray_budget: int = setting(
        128 * 8192,
        "pixels in memory of all keyframes; of more keyframes fewer each",
        unit="rays",
        minimum=4096,
        maximum=1_000_000_000,
    )
    links: int = setting(
        5, "older keyframes that a new one is registered with", minimum=0, maximum=100
    )


@dataclass(frozen=True)
class MappingConfig:
    """Joint optimisation of weights and poses (Sec. II-B)."""

    rays: int = setting(400, "rays of keyframes in a step", minimum=8, maximum=20000)
    current_rays: int = setting(
        150, "rays of the current frame in a step", minimum=0, maximum=20000
    )
    free_samples: int = setting(4, "samples of a ray in free space", minimum=1, maximum=64)
    surface_samples: int = setting(4, "samples of a ray near the surface", minimum=1, maximum=64)
    surface_sigma_m: float = setting(
        0.03, "spread of the samples near the surface", unit="m", minimum=0.005, maximum=0.5
    )
    first_iterations: int = setting(300, "steps on the first frame", minimum=1, maximum=10000)
    iterations: int = setting(
        16,
        "steps a frame",
        minimum=0,
        maximum=1000,
        live=True,
    )
    min_iterations: int = setting(
        6,
        "steps a frame even while frames wait to be tracked",
        minimum=0,
        maximum=1000,
        live=True,
    )
    keyframe_iterations: int = setting(
        30,
        "steps on a new keyframe",
        minimum=0,
        maximum=1000,
        live=True,
    )
    final_iterations: int = setting(
        4000,
        "steps after the last frame of a recording",
        minimum=0,
        maximum=100000,
        live=True,
    )
    learning_rate: float = setting(8e-3, "Adam's step for the weights", minimum=1e-6, maximum=0.1)
    pose_learning_rate: float = setting(
        2e-3, "Adam's step for keyframe poses", unit="m, rad", minimum=0.0, maximum=0.1
    )
    pose_decay_steps: float = setting(
        1000.0, "the poses' step halves after this many steps", minimum=1.0, maximum=1e9
    )
    latest_share: float = setting(
        0.2, "share of the keyframe rays drawn from the last keyframe", minimum=0.0, maximum=1.0
    )
    distance_weight: float = setting(
        5.0, "weight of the signed-distance loss", minimum=0.0, maximum=100.0
    )
    depth_weight: float = setting(
        0.5, "weight of the rendered-depth loss", minimum=0.0, maximum=100.0
    )
    color_weight: float = setting(
        1.0, "weight of the rendered-colour loss", minimum=0.0, maximum=100.0
    )
    odometry_weight: float = setting(
        2000.0,
        "weight of the measured motions between keyframes (squared error)",
        unit="1/m^2, 1/rad^2",
        minimum=0.0,
        maximum=1e6,
    )
    depth_clip_m: float = setting(
        0.2, "rendered-depth errors count up to this", unit="m", minimum=0.01, maximum=10.0
    )


@dataclass(frozen=True)
class RegionsConfig:
    """Distribution of networks in space (Sec. II-C)."""

    volume_m3: float = setting(
        30.0, "volume of a region's box (a cube)", unit="m^3", minimum=0.1, maximum=1e6
    )
    overlap: float = setting(
        0.2,
        "share of a region's side that it has in common with a neighbour",
        minimum=0.01,
        maximum=0.49,
    )
    hysteresis_m: float = setting(
        0.05,
        "how far past the middle of an intersection the working region changes",
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )
    mask_voxel_m: float = setting(
        0.08, "voxel of the mask of observed space", unit="m", minimum=0.02, maximum=0.5
    )
    mask_extent: float = setting(
        3.0,
        "half-sides of the box up to which a region remembers what it saw",
        minimum=1.0,
        maximum=6.0,
    )
    initialisation: str = setting(
        "continued",
        "how a new region's network begins: 'continued': the working region's map goes on in it, "
        "exactly; 'copied': the weights as they are, as in the paper; 'random': from nothing",
        choices=("continued", "copied", "random"),
    )
    single: bool = setting(False, "one network for everything: no region is made but the first")
    close_loops: bool = setting(
        True,
        "a region that is come back to is recognised, and the path since is corrected by what that "
        "says; else it is trained wherever the camera is believed to be",
    )


@dataclass(frozen=True)
class MapConfig:
    """What is answered from the stored networks, and how."""

    mesh_resolution_m: float = setting(
        0.02, "default spacing of a mesh", unit="m", minimum=0.002, maximum=1.0
    )
    blend_length: float = setting(
        0.25,
        "half-sides over which a region's weight falls by e from its centre",
        minimum=0.01,
        maximum=10.0,
    )
    codec: str = setting("int8", "how weights are stored", choices=("int8", "fp16", "fp32"))


@dataclass(frozen=True)
class RuntimeConfig:
    """How the computer is used."""

    threads: int = setting(1, "threads of one tensor operation on the CPU", minimum=1, maximum=256)
    queue: int = setting(
        4, "frames that odometry may be ahead of tracking", unit="frames", minimum=1, maximum=1000
    )
    work_dir: str = setting(
        "", "folder for regions at rest while mapping; empty: the system's temporary folder"
    )


@dataclass(frozen=True)
class MeslamConfig:
    """The whole configuration, one section a part of the system."""

    sensor: SensorConfig = SensorConfig()
    odometry: OdometryConfig = OdometryConfig()
    field: FieldConfig = FieldConfig()
    tracking: TrackingConfig = TrackingConfig()
    relocalisation: RelocalisationConfig = RelocalisationConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    mapping: MappingConfig = MappingConfig()
    regions: RegionsConfig = RegionsConfig()
    map: MapConfig = MapConfig()
    runtime: RuntimeConfig = RuntimeConfig()

    @classmethod
    def from_mapping(cls, values: Mapping[str, Mapping[str, Any]]) -> MeslamConfig:
        """Defaults with `{section: {name: value}}` in their place.

        Raises:
            ConfigError: for unknown sections or names, wrong types, values out of range.
        """
        known = {(s.section, s.name): s for s in settings()}
        sections: dict[str, dict[str, Any]] = {}
        for section, entries in values.items():
            if not isinstance(entries, Mapping):
                raise ConfigError(f"section {section!r} holds {entries!r}, expected a mapping")
            for name, value in entries.items():
                if (section, name) not in known:
                    raise ConfigError(
                        f"there is no setting {section}.{name}; {_suggestion(section, name)}"
                    )
                sections.setdefault(section, {})[name] = known[section, name].checked(value)
        config = cls()
        return dataclasses.replace(
            config,
            **{s: dataclasses.replace(getattr(config, s), **v) for s, v in sections.items()},
        )

    @classmethod
    def from_overrides(cls, overrides: Sequence[str], preset: str = "default") -> MeslamConfig:
        """The configuration of a preset with `section.name=value` texts applied in order.

        Raises:
            ConfigError: as `from_mapping`, and for malformed texts or unknown presets.
        """
        if preset not in PRESETS:
            raise ConfigError(f"there is no preset {preset!r}; choose one of {', '.join(PRESETS)}")
        values: dict[str, dict[str, Any]] = {s: dict(v) for s, v in PRESETS[preset].items()}
        for text in overrides:
            path, equals, value = text.partition("=")
            section, dot, name = path.strip().partition(".")
            if not equals or not dot:
                raise ConfigError(f"{text!r} is not of the form section.name=value")
            try:
                values.setdefault(section, {})[name] = _parsed(value)
            except yaml.YAMLError as error:
                raise ConfigError(f"the value of {text!r} is neither number nor text") from error
        return cls.from_mapping(values)

    def to_mapping(self) -> dict[str, dict[str, Any]]:
        """`{section: {name: value}}` of all settings."""
        return dataclasses.asdict(self)


def _parsed(text: str) -> Any:
    """A YAML scalar; YAML 1.1 takes 3e-4 for a string, people mean a number."""
    value = yaml.safe_load(text)
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _suggestion(section: str, name: str) -> str:
    names = [s.name for s in settings() if s.section == section]
    if names:
        return f"section {section} has {', '.join(names)}"
    return f"sections are {', '.join(f.name for f in dataclasses.fields(MeslamConfig))}"


def settings() -> Iterator[Setting]:
    """Every setting in the order of its declaration."""
    for section in dataclasses.fields(MeslamConfig):
        for entry in dataclasses.fields(type(getattr(MeslamConfig(), section.name))):
            default: Any = entry.default
            yield Setting(section.name, entry.name, default, **entry.metadata)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "default": {},
    "fine": {"field": {"width": 128}},
    "paper": {"field": {"width": 256}, "odometry": {"method": "colored_icp"}},
    # The paper's baseline: one network for a cube of 48 m, with nearly the default's frequencies
    # a metre; no odometry, and nothing registered.
    "imap_star": {
        "odometry": {"method": "none"},
        "field": {"width": 256, "embedding_sigma": 100.0},
        "keyframes": {"links": 0},
        "regions": {
            "single": True,
            "volume_m3": 110592.0,
            "mask_voxel_m": 0.16,
            "mask_extent": 1.0,
        },
    },
}
