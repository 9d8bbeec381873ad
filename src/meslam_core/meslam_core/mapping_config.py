"""The numbers of the map and of what trains it: networks, keyframes, regions, storage."""

from __future__ import annotations

from dataclasses import dataclass

from meslam_core.setting import setting


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
        "steps a frame even while frames wait to be tracked; after skipped ones also theirs",
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
