"""Truth that another device stamped: how far its clock is off, and its poses at our stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from meslam_core.errors import EvaluationError
from meslam_core.trajectory import NANOSECONDS, Trajectory

# The offset is sought within so many seconds, in such steps.
MAX_OFFSET_S = 0.2
STEP_S = 0.005
# True poses farther apart are not interpolated [s].
MAX_GAP_S = 0.25
LEAST_POSES = 10


def clock_offset_s(estimate: Trajectory, truth: Trajectory) -> float:
    """What to add to the estimate's stamps so that both turn at the same times [s].

    The offset, in steps of 5 ms, at which the rates of turning correlate best. They need neither
    an alignment nor the mounting of the true sensor, and where it turns steadily they tell nothing.

    Raises:
        EvaluationError: when fewer than ten true poses lie close enough together.
    """
    steps = round(MAX_OFFSET_S / STEP_S)
    # Of offsets that are alike the smallest comes first.
    offsets_s = sorted((step * STEP_S for step in range(-steps, steps + 1)), key=abs)
    return max(offsets_s, key=lambda offset_s: _likeness(estimate, truth, offset_s))


def at_stamps(
    truth: Trajectory, stamps_ns: NDArray[np.int64], offset_s: float = 0.0
) -> tuple[NDArray[np.int64], Trajectory]:
    """True poses at given stamps, interpolated.

    Args:
        truth: on its own clock.
        stamps_ns: (N,) int64, increasing [ns].
        offset_s: of the truth's clock, see `clock_offset_s` [s].

    Returns:
        The indices (M,) of the stamps that the truth covers, and the poses there at those stamps.

    Raises:
        EvaluationError: when there are fewer than ten.
    """
    wanted = stamps_ns + round(offset_s * NANOSECONDS)
    after = np.clip(np.searchsorted(truth.stamps_ns, wanted), 1, max(len(truth) - 1, 1))
    known = truth.stamps_ns
    covered = np.zeros(len(wanted), bool)
    if len(truth) > 1:
        close = known[after] - known[after - 1] <= round(MAX_GAP_S * NANOSECONDS)
        covered = (wanted >= known[0]) & (wanted <= known[-1]) & close
    indices = np.flatnonzero(covered)
    if len(indices) < LEAST_POSES:
        raise EvaluationError(
            f"the truth covers {len(indices)} of {len(stamps_ns)} poses; at least {LEAST_POSES} "
            "are needed: are both on the same clock?"
        )
    known_s = (known - known[0]) / NANOSECONDS
    wanted_s = (wanted[indices] - known[0]) / NANOSECONDS
    poses = np.tile(np.eye(4), (len(indices), 1, 1))
    turning = Slerp(known_s, Rotation.from_matrix(truth.rotations))
    poses[:, :3, :3] = turning(wanted_s).as_matrix()
    for axis in range(3):
        poses[:, axis, 3] = np.interp(wanted_s, known_s, truth.positions[:, axis])
    return indices, Trajectory(stamps_ns[indices], poses)


def _likeness(estimate: Trajectory, truth: Trajectory, offset_s: float) -> float:
    """Correlation of the rates of turning, taken over the same steps."""
    indices, true = at_stamps(truth, estimate.stamps_ns, offset_s)
    whole = np.diff(indices) == 1
    rates = [_turns(poses)[whole] for poses in (estimate.subset(indices), true)]
    if whole.sum() < LEAST_POSES or min(np.ptp(each) for each in rates) <= 0.0:
        return 0.0
    return float(np.corrcoef(*rates)[0, 1])


def _turns(trajectory: Trajectory) -> NDArray[np.float64]:
    """Rate of turning in each step [rad/s]."""
    turned = trajectory.rotations[:-1].transpose(0, 2, 1) @ trajectory.rotations[1:]
    steps_s = np.diff(trajectory.stamps_ns) / NANOSECONDS
    rates: NDArray[np.float64] = Rotation.from_matrix(turned).magnitude() / steps_s
    return rates
