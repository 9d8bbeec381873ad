"""How far the map may be off at a keyframe, from links that agree or do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from meslam_core.mapping.keyframes import KeyframeStore, Rays
from meslam_core.se3 import Pose, exp, inverse
from meslam_core.tracking.map_uncertainty import ODOMETRY_FACTOR, MapUncertainty

STEP_M = 0.1


def at(x: float, y: float = 0.0) -> Pose:
    return exp(np.array([x, y, 0.0, 0.0, 0.0, 0.0]))


def keyframes_at(poses: list[Pose]) -> KeyframeStore:
    """Keyframes without links."""
    store = KeyframeStore(1, torch.device("cpu"))
    ray = Rays(torch.tensor([[0.0, 0.0, 1.0]]), torch.ones(1), torch.zeros(1, 3))
    for number, pose in enumerate(poses):
        store.add(number, pose, ray)
    return store


def tie(
    store: KeyframeStore, i: int, j: int, off_m: float = 0.0, off_rad: float = 0.0, **weight: float
) -> None:
    """A link that says what the poses say, or something else."""
    said = inverse(store.pose(i)) @ store.pose(j) @ exp(np.array([off_m, 0, 0, 0, 0, off_rad]))
    store.add_link(i, j, said, **weight)


def corridor(count: int, **off: float) -> KeyframeStore:
    """Keyframes along x, each tied to the one before."""
    store = keyframes_at([at(STEP_M * number) for number in range(count)])
    for number in range(1, count):
        tie(store, number - 1, number, **off)
    return store


def covariance(store: KeyframeStore, keyframe: int) -> np.ndarray:
    uncertainty = MapUncertainty()
    uncertainty.update(store)
    return uncertainty.covariance(store.pose(keyframe)[:3, 3], keyframe)


def deviations(store: KeyframeStore, keyframe: int) -> tuple[float, float]:
    """Of position [m] and rotation [rad], root of the sum over the axes."""
    found = covariance(store, keyframe)
    return float(np.sqrt(np.trace(found[:3, :3]))), float(np.sqrt(np.trace(found[3:, 3:])))


def test_uncertainty_grows_with_the_way_from_the_first_keyframe():
    store = corridor(40)
    positions, angles = zip(*(deviations(store, number) for number in range(40)), strict=True)
    assert (np.diff(positions) > 0).all()
    assert (np.diff(angles) > 0).all()
    # A random walk: angles grow with the root of the number of links, the camera's own among them.
    assert angles[39] / angles[9] == pytest.approx(np.sqrt(40 / 10), rel=1e-6)


def test_an_uncertain_direction_moves_what_lies_ahead_sideways():
    found = covariance(corridor(40), 39)
    along, sideways = found[0, 0], found[1, 1]
    assert sideways > 3 * along
    # Who turned left by mistake is too far left.
    assert found[1, 5] > 0
    assert np.linalg.eigvalsh(found).min() > 0
    np.testing.assert_allclose(found, found.T)


def test_a_recognised_place_is_as_certain_as_where_it_was_seen_first():
    store = corridor(60)
    lost, _ = deviations(store, 59)
    tie(store, 1, 59)
    found, _ = deviations(store, 59)
    assert found < 0.35 * lost
    # Halfway along the loop both ends hold.
    assert deviations(store, 30)[0] > deviations(store, 10)[0]
    assert deviations(store, 30)[0] > deviations(store, 50)[0]


def test_links_that_disagree_with_the_map_make_it_less_certain():
    agreeing = deviations(corridor(40), 39)
    shifted = deviations(corridor(40, off_m=0.02), 39)
    turned = deviations(corridor(40, off_rad=0.02), 39)
    assert shifted[0] > 2 * agreeing[0]
    assert shifted[1] == pytest.approx(agreeing[1])
    assert turned[1] > 2 * agreeing[1]


def test_a_contradicted_link_is_gone_around():
    store = corridor(10)
    tie(store, 0, 9, off_m=0.3)
    straight = deviations(corridor(10), 9)[0]
    assert deviations(store, 9)[0] < 2 * straight


def test_a_map_whose_only_link_is_contradicted_may_be_that_far_off():
    store = keyframes_at([at(STEP_M * number) for number in range(8)])
    for number in range(1, 8):
        tie(store, number - 1, number, off_m=0.2 if number == 4 else 0.0)
    assert deviations(store, 3)[0] < 0.1
    assert deviations(store, 4)[0] > 0.2


def test_odometry_holds_less_than_registration():
    registered, driven = keyframes_at([at(0), at(0.1)]), keyframes_at([at(0), at(0.1)])
    tie(registered, 0, 1)
    tie(driven, 0, 1, weight=0.05)
    untied = keyframes_at([at(0), at(0.1)])
    angles = [deviations(store, 1)[1] for store in (registered, driven, untied)]
    assert angles[0] < angles[1] < angles[2]
    assert angles[1] < np.sqrt(ODOMETRY_FACTOR) * angles[0]


def test_a_stored_map_is_what_a_new_session_is_measured_against():
    store = keyframes_at([at(float(number)) for number in range(5)])
    store.fixed = 3
    certain = [deviations(store, number)[0] for number in range(3)]
    assert certain == pytest.approx([certain[0]] * 3)
    assert deviations(store, 3)[0] > certain[0]
    assert deviations(store, 4)[0] > deviations(store, 3)[0]


def test_a_keyframe_not_linked_yet_is_as_uncertain_as_the_one_before():
    store = corridor(5)
    uncertainty = MapUncertainty()
    uncertainty.update(store)
    place = store.pose(4)[:3, 3]
    np.testing.assert_array_equal(
        uncertainty.covariance(place, 5), uncertainty.covariance(place, 4)
    )


def test_without_keyframes_the_camera_alone_errs():
    uncertainty = MapUncertainty()
    found = uncertainty.covariance(np.zeros(3), 0)
    assert 0 < np.sqrt(np.trace(found[:3, :3])) < 0.02
    np.testing.assert_array_equal(found, np.diag(np.diag(found)))
