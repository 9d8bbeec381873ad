"""Trajectory errors by evo, the reference: its programs are called, nothing of it is linked.

Grupp, *evo: Python package for the evaluation of odometry and SLAM*, 2017.
"""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from pathlib import Path

from meslam_core.evaluation.alignment import ASSOCIATION_TOLERANCE_S

TOLERANCE_M = 1e-6
# What evo says where the positions of a trajectory do not fix an alignment.
DEGENERATE = "Degenerate covariance rank"


class DisagreementError(Exception):
    """evo and our own evaluation say different things of the same trajectory."""


def evo_rmse(
    estimate: Path, truth: Path, *, relative: bool = False, align: bool = True
) -> float | None:
    """RMSE of the translational error [m] by `evo_ape`, or from frame to frame by `evo_rpe`.

    Args:
        estimate, truth: TUM files.
        relative: errors of the motion between consecutive pairs instead of positions.
        align: rigidly first; relative errors do not depend on it.

    Returns:
        None where the trajectory is degenerate for evo, such as one that never moves.

    Raises:
        DisagreementError: when evo cannot judge the trajectory for another reason.
    """
    name = "evo_rpe" if relative else "evo_ape"
    result = estimate.with_suffix(f".{name}.zip")
    result.unlink(missing_ok=True)
    command = [str(Path(sys.executable).parent / name), "tum", str(truth), str(estimate)]
    command += ["--t_max_diff", str(ASSOCIATION_TOLERANCE_S), "--save_results", str(result)]
    command += ["--silent", "--no_warnings"]
    if relative:
        command += ["--delta", "1", "--delta_unit", "f"]
    elif align:
        command += ["--align"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if not result.exists():
        said = (ended.stdout + ended.stderr).strip()
        if DEGENERATE in said:
            return None
        raise DisagreementError(f"{name} gives no error for {estimate}: {said}")
    with zipfile.ZipFile(result) as archive:
        rmse = float(json.loads(archive.read("stats.json"))["rmse"])
    result.unlink()
    return rmse


def check_agreement(what: str, ours_m: float, evo_m: float | None) -> None:
    """Compare an error of ours with evo's, where evo has one.

    Raises:
        DisagreementError: when they differ by a micrometre or more.
    """
    if evo_m is not None and not abs(ours_m - evo_m) < TOLERANCE_M:
        raise DisagreementError(
            f"{what}: our evaluation says {1e3 * ours_m:.6f} mm, evo {1e3 * evo_m:.6f} mm"
        )
