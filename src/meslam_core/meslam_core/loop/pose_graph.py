"""Poses of all keyframes from the motions measured between them, by Gauss-Newton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, csc_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from meslam_core.mapping.keyframe_links import LINK_OUTLIER, KeyframeLinks
from meslam_core.se3 import Pose

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ITERATIONS = 6
# A step that moves no pose farther than this ends the search [m, rad].
CONVERGENCE = 1e-4
# Keyframes that nothing measured ties keep their motion, unless something else moves them.
KEPT_WEIGHT = 0.01
# Of the first pose, which holds the map in its frame.
FIXED_WEIGHT = 1e9


@dataclass(frozen=True)
class MeasuredMotion:
    """A motion that is believed however little it agrees with the poses so far.

    Attributes:
        first, second: numbers of two keyframes.
        T_first_second: (4, 4), the second's camera coordinates to the first's.
    """

    first: int
    second: int
    T_first_second: Pose


@dataclass(frozen=True)
class _Edges:
    """Measured motions as the search needs them.

    Attributes:
        first, second: (E,) numbers of poses.
        T_second_first: (E, 4, 4).
        weights: (E,).
        robust: (E,) whether one that disagrees lets go.
    """

    first: Integers
    second: Integers
    T_second_first: Floats
    weights: Floats
    robust: NDArray[np.bool_]


def optimised_poses(poses: Floats, links: KeyframeLinks, loops: Sequence[MeasuredMotion]) -> Floats:
    """The poses that agree best with all measured motions; the first one stays.

    Minimises the weighted squares of the shift and turn of T_ij^-1 T_i^-1 T_j (Grisetti et al.
    2010, poses moved in their own frames). Links count robustly, loops in full.

    Args:
        poses: (K, 4, 4) T_map_camera.
        links: between keyframes.
        loops: motions between keyframes that were recognised.
    """
    poses = poses.astype(np.float64).copy()
    edges = _edges(poses, links, loops)
    for _ in range(ITERATIONS):
        step = _step(poses, edges)
        poses[:, :3, 3] += np.einsum("kij,kj->ki", poses[:, :3, :3], step[:, :3])
        poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(step[:, 3:]).as_matrix()
        if np.abs(step).max() < CONVERGENCE:
            break
    return poses


def rigid_motion(before: Floats, after: Floats) -> Pose:
    """The motion (4, 4), map axes, that takes poses (K, 4, 4) closest to others.

    The rotation comes from the poses' own, so that poses on a line, or one alone, suffice.
    """
    turned = np.einsum("kij,klj->il", after[:, :3, :3], before[:, :3, :3])
    u, _, vt = np.linalg.svd(turned)
    motion = np.eye(4)
    motion[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    motion[:3, 3] = after[:, :3, 3].mean(axis=0) - motion[:3, :3] @ before[:, :3, 3].mean(axis=0)
    return motion


def _edges(poses: Floats, links: KeyframeLinks, loops: Sequence[MeasuredMotion]) -> _Edges:
    measured = links.all()
    tied = {tuple(sorted(pair)) for pair in measured.ends.tolist()}
    loose = np.array([k for k in range(1, len(poses)) if (k - 1, k) not in tied], np.int64)
    motions = np.tile(np.eye(4), (len(measured.ends), 1, 1))
    motions[:, :3, :3] = measured.rotations
    motions[:, :3, 3] = measured.translations
    kept = _inverse(poses[loose - 1]) @ poses[loose]
    recognised = np.array([loop.T_first_second for loop in loops]).reshape(-1, 4, 4)
    ends = np.concatenate(
        [
            measured.ends,
            np.stack([loose - 1, loose], axis=1),
            np.array([(loop.first, loop.second) for loop in loops], np.int64).reshape(-1, 2),
        ]
    )
    weights = [measured.weights, np.full(len(loose), KEPT_WEIGHT), np.ones(len(loops))]
    return _Edges(
        ends[:, 0],
        ends[:, 1],
        _inverse(np.concatenate([motions, kept, recognised])),
        np.concatenate(weights).astype(np.float64),
        np.arange(len(ends)) < len(ends) - len(loops),
    )


def _step(poses: Floats, edges: _Edges) -> Floats:
    """Twists (K, 6) of the poses in their own frames; the first one's is zero."""
    relative = _inverse(poses[edges.first]) @ poses[edges.second]
    apart = edges.T_second_first @ relative
    turns = Rotation.from_matrix(apart[:, :3, :3]).as_rotvec()
    errors = np.concatenate([apart[:, :3, 3], turns], axis=1)
    squared = np.sum(errors * errors, axis=1) / LINK_OUTLIER**2
    # Geman-McClure.
    weights = np.where(edges.robust, edges.weights / (1.0 + squared) ** 2, edges.weights)
    by_first = -_adjoint(_inverse(relative))
    weighted = weights[:, None, None] * by_first.transpose(0, 2, 1)
    diagonal = weights[:, None, None] * np.eye(6)
    count = len(poses)
    gradient = np.zeros((count, 6))
    np.add.at(gradient, edges.first, np.einsum("eij,ej->ei", weighted, errors))
    np.add.at(gradient, edges.second, weights[:, None] * errors)
    damping = np.tile(1e-9 * np.eye(6), (count, 1, 1))
    damping[0] = FIXED_WEIGHT * np.eye(6)
    blocks = [weighted @ by_first, weighted, weighted.transpose(0, 2, 1), diagonal, damping]
    first, second, every = edges.first, edges.second, np.arange(count)
    rows = np.concatenate([first, first, second, second, every])
    columns = np.concatenate([first, second, first, second, every])
    hessian = _assembled(np.concatenate(blocks), rows, columns, count)
    step = np.asarray(spsolve(hessian, -gradient.reshape(-1)), np.float64).reshape(count, 6)
    step[0] = 0.0
    return step


def _assembled(blocks: Floats, rows: Integers, columns: Integers, count: int) -> csc_matrix:
    """The sparse matrix of 6x6 blocks; those of one place are summed."""
    places, place_of = np.unique(rows * count + columns, return_inverse=True)
    data = np.zeros((len(places), 6, 6))
    np.add.at(data, place_of, blocks)
    starts = np.searchsorted(places // count, np.arange(count + 1))
    matrix = bsr_matrix((data, places % count, starts), shape=(6 * count, 6 * count))
    return matrix.tocsc()


def _inverse(poses: Floats) -> Floats:
    """Inverses of rigid poses (N, 4, 4)."""
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, 3] = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return result


def _adjoint(poses: Floats) -> Floats:
    """Adjoints (N, 6, 6) as `se3.adjoint` has them."""
    result = np.zeros((len(poses), 6, 6))
    x, y, z = poses[:, :3, 3].T
    hat = np.zeros((len(poses), 3, 3))
    hat[:, 0, 1], hat[:, 0, 2], hat[:, 1, 2] = -z, y, -x
    hat -= hat.transpose(0, 2, 1)
    result[:, :3, :3] = result[:, 3:, 3:] = poses[:, :3, :3]
    result[:, :3, 3:] = hat @ poses[:, :3, :3]
    return result
