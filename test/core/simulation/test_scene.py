"""The building blocks of scenes."""

from __future__ import annotations

import numpy as np
import pytest

from meslam_core.errors import ConfigError
from meslam_core.simulation.scene import Patch, box, cylinder, quad, sphere
from meslam_core.simulation.scenes import SCENES, build_scene
from meslam_core.simulation.textures import checker

TEXTURE = checker((0.2, 0.2, 0.2), (0.8, 0.8, 0.8), 0.1)


def triangle_centers_and_normals(patches: list[Patch]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.concatenate([patch.vertices[patch.triangles] for patch in patches])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return corners.mean(axis=1), normals


def enclosed_volume(patches: list[Patch]) -> float:
    centers, normals = triangle_centers_and_normals(patches)
    return float((centers * normals).sum() / 6)


def test_box_faces_look_outwards_and_enclose_it():
    patches = box((1.0, 2.0, 3.0), (0.5, 0.4, 0.2), TEXTURE, yaw=0.7, without=())
    assert enclosed_volume(patches) == pytest.approx(0.04)
    centers, normals = triangle_centers_and_normals(patches)
    assert (((centers - (1, 2, 3)) * normals).sum(axis=1) > 0).all()


def test_box_faces_can_be_left_out_and_painted_differently():
    other = checker((1, 0, 0), (0, 1, 0), 0.1)
    patches = box((0, 0, 0), (1, 1, 1), {"side": TEXTURE, "top": other}, without=("bottom", "left"))
    assert len(patches) == 4
    assert [patch.texture for patch in patches].count(other) == 1
    with pytest.raises(KeyError, match="no texture for its face 'left'"):
        box((0, 0, 0), (1, 1, 1), {"top": other})


def test_sphere_is_round_and_looks_outwards():
    patch = sphere((1, 1, 1), 0.3, TEXTURE)
    np.testing.assert_allclose(np.linalg.norm(patch.vertices - 1, axis=1), 0.3)
    assert enclosed_volume([patch]) == pytest.approx(4 / 3 * np.pi * 0.3**3, rel=0.02)


def test_cylinder_looks_outwards():
    patches = cylinder((2, 1, 0), 0.2, 0.5, TEXTURE)
    # Without a bottom at z = 0 nothing is missing from the surface integral.
    assert enclosed_volume(patches) == pytest.approx(np.pi * 0.04 * 0.5, rel=0.02)


def test_unrolling_keeps_lengths():
    for patch in [
        quad((0, 0, 1), (2, 0, 0), (0, 0, -1), TEXTURE, 0.01),
        *box((0, 0, 0), (1, 2, 3), TEXTURE, yaw=0.3, without=()),
        *cylinder((0, 0, 0), 0.3, 1.0, TEXTURE, segments=64),
    ]:
        solid, flat = patch.vertices[patch.triangles], patch.coordinates[patch.triangles]
        np.testing.assert_allclose(
            np.linalg.norm(solid[:, 1] - solid[:, 0], axis=1),
            np.linalg.norm(flat[:, 1] - flat[:, 0], axis=1),
            rtol=2e-3,
        )
        assert (flat.min(axis=(0, 1)) >= -1e-9).all()
        assert (flat.max(axis=(0, 1)) <= np.array([patch.width_m, patch.height_m]) + 1e-9).all()


def test_unknown_scene_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"no scene 'moon'.*room"):
        build_scene("moon")


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scene_is_the_same_every_time(name):
    first, second = build_scene(name), build_scene(name)
    assert first.name == name
    np.testing.assert_array_equal(first.route.anchors, second.route.anchors)
    for one, other in zip(first.patches, second.patches, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
