"""The numbers of the sensor and of finding the pose: odometry, tracking, relocalisation."""

from __future__ import annotations

from dataclasses import dataclass

from meslam_core.errors import ConfigError
from meslam_core.setting import setting


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

    def __post_init__(self) -> None:
        if self.min_depth_m >= self.max_depth_m:
            raise ConfigError(
                f"sensor.min_depth_m = {self.min_depth_m:g} m is not below sensor.max_depth_m = "
                f"{self.max_depth_m:g} m: no depth would be believed"
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
        0.95,
        "share of inliers from which on the map alone tells the pose where odometry has failed and "
        "no keyframe knows the view",
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
