"""How far the map is off where the camera is: what the surest chain of links leaves open.

The map's frame is that of its first keyframe. Every other keyframe, and with it what the map shows
around it, is tied to the first one by links, each of which may be wrong; along a path the errors
add up, and where a place is recognised a shorter chain takes over. How wrong a link may be is read
from how far links and map disagree, since a camera whose links agree within millimetres drifts less
than one whose links do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from meslam_core.mapping.keyframe_links import LinkBlock
from meslam_core.mapping.keyframes import KeyframeStore

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# All variances are those of one axis: (translation [m^2], rotation [rad^2]).
# Before links tell otherwise a link is believed to err so much; it counts as so many links.
EXPECTED = np.array([0.005, np.deg2rad(0.3)]) ** 2
EXPECTED_LINKS = 15.0
# What is alike in all links, such as the depth camera's own error, shows in no disagreement.
COMMON = np.array([0.003, np.deg2rad(0.07)]) ** 2
# The poses follow the links that they are compared with, so that disagreement understates error:
# with K poses and L links alone by sqrt(1 - K / L), 0.8 for three links a keyframe. The map pulls
# at them too; calibrated by benchmarks/covariance.py.
UNDERSTATED = 1.5**2
# What a loop of links misses is spread over them: along a chain such parts add up, as if each
# were about twice as large and on its own.
OWN_FACTOR = 4.0
# One link that is far off says little of the others.
LARGEST = 0.03**2
# Odometry over the frames between, and two keyframes that only the map ties.
ODOMETRY_FACTOR = 4.0
UNTIED_FACTOR = 16.0
# Links below this weight are odometry's.
REGISTERED_WEIGHT = 0.5
# To choose a chain, a turn counts as what it moves at this distance [m].
LEVER_M = 1.0


@dataclass(frozen=True)
class _Chain:
    """The surest way from the first keyframe to another one.

    Attributes:
        positions: (N, 3) of the keyframe at the far end of each link [m].
        variances: (N, 2) of each link.
    """

    positions: Floats
    variances: Floats


class MapUncertainty:
    """Covariance of the map's own error at a place, relative to its first keyframe.

    Only the differences to what is fixed count: in a stored map that is gone on with, the map as
    it was stored is without error.
    """

    def __init__(self) -> None:
        self._seen = (0, 0)
        self._link = UNDERSTATED * EXPECTED + COMMON
        self._positions: Floats = np.zeros((0, 3))
        self._before: Integers = np.zeros(0, np.int64)
        self._variances: Floats = np.zeros((0, 2))
        self._chains: dict[int, _Chain] = {}

    def update(self, keyframes: KeyframeStore) -> None:
        """Take up new keyframes and links; nobody may move or add any meanwhile."""
        seen = (len(keyframes), len(keyframes.links))
        if seen == self._seen:
            return
        self._seen = seen
        rotations, translations = keyframes.pose_arrays()
        links = keyframes.links.all()
        self._positions = translations.astype(np.float64)
        self._chains = {}
        own = _disagreements(links, rotations, translations)
        registered = links.weights >= REGISTERED_WEIGHT
        total = np.minimum(own[registered], LARGEST).sum(axis=0) + EXPECTED_LINKS * EXPECTED
        common = total / (np.count_nonzero(registered) + EXPECTED_LINKS)
        self._link = UNDERSTATED * common + COMMON
        factor = np.where(registered, 1.0, ODOMETRY_FACTOR)[:, None]
        variances = UNDERSTATED * (factor * common + OWN_FACTOR * own) + COMMON
        self._find_chains(links.ends, variances, keyframes.fixed)

    def covariance(self, position: Floats, keyframe: int) -> Floats:
        """Covariance (6, 6) of (translation [m], rotation [rad]) about a camera, map axes.

        Args:
            position: (3,) of the camera [m].
            keyframe: the one whose surroundings the camera was tracked in. One that is not known
                yet is tracked in those of the latest one that is.
        """
        result = np.zeros((6, 6))
        # The camera's own image errs like those that links were measured with.
        result[[0, 1, 2], [0, 1, 2]] = self._link[0]
        result[[3, 4, 5], [3, 4, 5]] = self._link[1]
        if not len(self._positions):
            return result
        chain = self._chain(min(keyframe, len(self._positions) - 1))
        # A link's turn moves the camera about the keyframe at its end.
        x, y, z = (position - chain.positions).T
        turning = chain.variances[:, 1]
        shift = np.array([[0.0 * x, z, -y], [-z, 0.0 * x, x], [y, -x, 0.0 * x]])
        cross = np.einsum("ijn,n->ij", shift, turning)
        result[:3, :3] += np.einsum("ikn,n,jkn->ij", shift, turning, shift)
        result[:3, :3] += chain.variances[:, 0].sum() * np.eye(3)
        result[:3, 3:] += cross
        result[3:, :3] += cross.T
        result[3:, 3:] += turning.sum() * np.eye(3)
        return result

    def _find_chains(self, ends: Integers, variances: Floats, fixed: int) -> None:
        """For every keyframe the one before it on its surest chain, and that link's variances."""
        count = len(self._positions)
        ends = np.sort(ends, axis=1)
        tied = ends[ends[:, 1] - ends[:, 0] == 1, 1]
        alone = np.setdiff1d(np.arange(max(fixed, 1), count), tied)
        untied = np.tile(UNDERSTATED * UNTIED_FACTOR * EXPECTED + COMMON, (len(alone), 1))
        variances = np.concatenate([variances, untied])
        ends = np.concatenate([ends, np.stack([alone - 1, alone], axis=1)])
        costs = variances @ (1.0, LEVER_M**2)
        order = np.argsort(costs, kind="stable")
        _, best = np.unique(ends[order] @ (count, 1), return_index=True)
        chosen = order[best]
        graph = csr_array((costs[chosen], tuple(ends[chosen].T)), shape=(count, count))
        _, before, _ = dijkstra(
            graph,
            directed=False,
            indices=np.arange(max(fixed, 1)),
            min_only=True,
            return_predecessors=True,
        )
        self._before = before.astype(np.int64)
        self._variances = np.zeros((count, 2))
        tied = np.flatnonzero(self._before >= 0)
        pairs = np.sort(np.stack([self._before[tied], tied], axis=1), axis=1) @ (count, 1)
        keys = ends[chosen] @ (count, 1)
        self._variances[tied] = variances[chosen[np.searchsorted(keys, pairs)]]

    def _chain(self, keyframe: int) -> _Chain:
        if keyframe not in self._chains:
            numbers = []
            number = keyframe
            while self._before[number] >= 0:
                numbers.append(number)
                number = int(self._before[number])
            self._chains[keyframe] = _Chain(self._positions[numbers], self._variances[numbers])
        return self._chains[keyframe]


def _disagreements(
    links: LinkBlock, rotations: NDArray[np.float32], translations: NDArray[np.float32]
) -> Floats:
    """Mean square (L, 2) of an axis by which links and poses differ, in shift and in turn."""
    first, second = links.ends.T
    R_map_first = rotations[first].astype(np.float64)
    moved = (R_map_first @ links.translations[:, :, None].astype(np.float64))[:, :, 0]
    shift = translations[second].astype(np.float64) - translations[first] - moved
    # Of two rotations that differ by a small angle a, |A - B|^2 = 2 a^2 (Frobenius).
    turn = R_map_first @ links.rotations.astype(np.float64) - rotations[second]
    squared = np.stack([np.square(shift).sum(axis=1), 0.5 * np.square(turn).sum(axis=(1, 2))], 1)
    result: Floats = squared / 3.0
    return result
