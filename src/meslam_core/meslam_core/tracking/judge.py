"""What is made of a frame's alignment with the map: a pose, a guess, or nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from meslam_core.config import RelocalisationConfig, TrackingConfig
from meslam_core.mapping.keyframes import Rays
from meslam_core.regions.region import Region
from meslam_core.se3 import Pose
from meslam_core.tracking.field_tracker import Alignment, PosePrior
from meslam_core.tracking.plausibility import Plausibility, motion_between

# Tells where a frame was taken, T_map_camera (4, 4), by the keyframes before a number; None where
# they do not show the place.
Witness = Callable[[int | None], Pose | None]
# Whether the latest keyframe's image shows that a frame was taken at T_map_camera (4, 4).
Attest = Callable[[Pose], bool]


@dataclass(frozen=True)
class Verdict:
    """What is made of an alignment.

    Attributes:
        trusted: whether the frame may train the map.
        confirmed: whether its pose is what the alignment says, for certain.
        guessed: whether that is at least the best guess.
        elsewhere: whether the frame shows a place that is known and not where it seems to be.
        reason: why it is not confirmed; empty where it is.
    """

    trusted: bool
    confirmed: bool = False
    guessed: bool = False
    elsewhere: bool = False
    reason: str = ""


class Judge:
    """Decides whether alignments may be trusted, or odometry in their place.

    Args:
        config: limits of what fits the map.
        relocalisation: how well a pose must agree with what keyframes tell.
        path: how far the path to the latest frame can be believed.

    Attributes:
        refuted_since: the keyframes from this number on were taken where the camera seemed to be
            and was not; whoever drops them sets it to None.
    """

    def __init__(
        self, config: TrackingConfig, relocalisation: RelocalisationConfig, path: Plausibility
    ) -> None:
        self.refuted_since: int | None = None
        self._config = config
        self._relocalisation = relocalisation
        self._path = path

    def verdict(
        self,
        stamp_ns: int,
        region: Region,
        rays: Rays,
        alignment: Alignment,
        prior: PosePrior,
        witness: Witness,
        attest: Attest,
    ) -> Verdict:
        """Whether an alignment may be trusted, or odometry in its place."""
        path = self._path
        unmapped = self._unmapped(alignment)
        if unmapped and path.followed:
            # Beyond what is mapped only odometry knows; without it the map could not grow.
            return Verdict(trusted=True, reason=unmapped)
        misfit = unmapped or self._misfit(alignment)
        if misfit and not path.doubted and attest(prior.T_map_camera):
            # Odometry and a keyframe agree: it is the map that lags behind.
            return Verdict(trusted=True, reason=misfit)
        objection = misfit or self._objection(stamp_ns, alignment, prior)
        if objection:
            return self._refused(prior, witness, objection)
        if not path.doubted:
            return Verdict(trusted=True, confirmed=True)
        return self._adrift(region, rays, alignment, witness)

    def _unmapped(self, alignment: Alignment) -> str:
        """Whether the map cannot tell, for it ends before the camera: what is said then."""
        finite = np.isfinite(alignment.T_map_camera).all()
        if not finite or alignment.observed_ratio >= self._config.min_observed_ratio:
            return ""
        return f"only {alignment.observed_ratio:.0%} of the view is mapped"

    def _misfit(self, alignment: Alignment) -> str:
        """How a frame misfits the map; empty where it fits."""
        limits = self._config
        if alignment.inlier_ratio < limits.min_inlier_ratio:
            return f"only {alignment.inlier_ratio:.0%} of the points lie on the map"
        if alignment.residual_m > limits.max_residual_m:
            return f"points lie {alignment.residual_m * 100:.1f} cm off the map"
        return ""

    def _objection(self, stamp_ns: int, alignment: Alignment, prior: PosePrior) -> str:
        """Why a pose that fits the map cannot be right; empty where it can."""
        pose = alignment.T_map_camera
        if not np.isfinite(pose).all():
            return "the pose is not finite"
        return self._path.impossible(stamp_ns, pose) or self._path.conflict(prior, pose)

    def _refused(self, prior: PosePrior, witness: Witness, objection: str) -> Verdict:
        """An alignment is not to be trusted; after odometry has failed keyframes may know more."""
        path = self._path
        known = witness(path.adrift_since) if path.doubted and path.asks() else None
        if known is None:
            return Verdict(trusted=False, reason=objection)
        distance, angle = motion_between(known, prior.T_map_camera)
        if not self._agree(distance, angle) and not path.drifted(distance, angle):
            self.refuted_since = path.adrift_since
        reason = f"{objection}; the view is known from {distance:.2f} m away"
        return Verdict(trusted=False, elsewhere=True, reason=reason)

    def _agree(self, distance_m: float, angle_rad: float) -> bool:
        """Whether two poses so far apart are the same place."""
        limits = self._relocalisation
        return distance_m <= limits.agreement_m and angle_rad <= np.deg2rad(limits.agreement_deg)

    def _adrift(
        self, region: Region, rays: Rays, alignment: Alignment, witness: Witness
    ) -> Verdict:
        """What is made of an alignment after odometry has failed."""
        path = self._path
        asked = path.asks()
        known = witness(path.adrift_since) if asked else None
        if known is None and asked and path.certain(region, rays, alignment):
            return Verdict(trusted=True, confirmed=True)
        if known is not None:
            distance, angle = motion_between(known, alignment.T_map_camera)
            if self._agree(distance, angle):
                return Verdict(trusted=True, confirmed=True)
            if not path.drifted(distance, angle):
                self.refuted_since = path.adrift_since
                reason = f"the view is known from {distance:.2f} m away"
                return Verdict(trusted=False, elsewhere=True, reason=reason)
        unlikely = path.unlikely(region, rays, alignment)
        if unlikely:
            return Verdict(trusted=False, reason=unlikely)
        reason = "odometry has failed, and nothing known before has been seen since"
        return Verdict(trusted=True, guessed=True, reason=reason)
