# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""A ball is told from a body that is none, with place and height of the departure; no images."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from semcal_ros.applications.reconstruction import Observations, Structure, adjust, fit_sphere
from semcal_ros.applications.reconstruction.ball import (
    Roundness,
    _quadrics,
    _SphereResiduals,
    measure_roundness,
)
from tests.helpers.structure_scenes import RADIUS_M, ball_scene


def examined(heights_m=None, *, seed=0, tip=False, **given) -> tuple[Roundness, np.ndarray]:
    """Roundness of a scene, and the sem_from_specimen rotation of its reference view."""
    options = {"views": 12, "points": 150, "sigma_px": 0.2} | given
    scene = ball_scene(heights_m=heights_m, seed=seed, **options)
    seen = Observations.from_tracks(scene.tracks, scene.cameras, 0.2)
    # The first view is not turned in the scene; the middle one is.
    done = adjust(
        seen, scene.cameras, scene.rotations, scene.translations_m, scene.points_m, reference=6,
        height_sigma_m=0.42e-6,
    )  # fmt: skip
    points = done.points_m
    outward = scene.points_m / np.linalg.norm(scene.points_m, axis=1)[:, None]
    structure = Structure(
        points, outward, np.full(len(points), 1.0 / RADIUS_M), done, seen, np.arange(12),
        tuple(scene.cameras), len(points), 0, 1.0, 0.0, 1.0, 0.0, 1e-9, 1, True,
    )  # fmt: skip
    sphere = fit_sphere(points, structure.normal_sigma_m)
    return measure_roundness(structure, sphere, 1.0), scene.rotations[6]


def test_a_ball_is_one():
    found = [examined(seed=seed, points=100)[0] for seed in range(12)]
    # One in 200 may be called none: two of 12 with a probability of 0.2 %.
    assert sum(not f.is_ball for f in found) <= 1
    # Nor is the uncertainty too large: small probabilities occur.
    assert min(f.probability for f in found) < 0.5


def test_a_bump_has_its_place_and_height():
    towards = np.array([0.2, -0.3, -1.0]) / np.linalg.norm([0.2, -0.3, -1.0])

    def heights(out):
        return 45e-9 * np.exp(-0.5 * np.sum((out - towards) ** 2, axis=1) / 0.2**2)

    found, rotation = examined(heights)
    assert not found.is_ball
    assert found.kind == "bump"
    assert found.height_m == pytest.approx(45e-9, abs=4.0 * found.height_sigma_m)
    assert found.height_sigma_m < 3e-9
    # A fifth of its width.
    assert found.towards @ rotation @ towards > np.cos(0.04)


def test_a_dent_is_told_from_a_bump():
    def heights(out):
        return -30e-9 * np.exp(-0.5 * np.sum((out + [0.0, 0.0, 1.0]) ** 2, axis=1) / 0.15**2)

    found, _ = examined(heights, seed=1)
    assert not found.is_ball
    assert found.height_m == pytest.approx(-30e-9, abs=4.0 * found.height_sigma_m)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_ellipsoid_of_three_per_cent_is_no_ball(axis):
    stretch = np.ones(3)
    stretch[axis] = 1.03

    def heights(out):
        return RADIUS_M * (1.0 / np.linalg.norm(out / stretch, axis=1) - 1.0)

    # Along the beam it is hardest to see: the front of it is much like that of a smaller ball.
    found, _ = examined(heights, seed=2, points=200, sigma_px=0.1)
    assert not found.is_ball
    # Less than 13.5 nm, as the best sphere of the part that is seen takes up some of it.
    assert 3.0 * found.height_sigma_m < found.height_m < 16e-9
    assert found.kind == "ellipsoid"


def test_what_holds_the_ball_is_not_a_bump():
    towards = np.array([0.6, 0.0, -0.8])

    def heights(out):
        # A rod from the surface outwards: points all along it.
        near = out @ towards > np.cos(0.12)
        rod = np.random.default_rng(0).uniform(0.1, 2.0, len(out)) * RADIUS_M
        return np.where(near, rod, 0.0)

    found, _ = examined(heights, seed=3, points=250)
    assert found.is_ball
    assert found.points < 250


@pytest.mark.parametrize("seed", range(4))
def test_one_wrong_point_far_from_the_others_is_no_ellipsoid(seed):
    """It bends a quadric so far towards itself that its own residual is small."""
    rng = np.random.default_rng(seed)
    cosine, turn = rng.uniform(0.5, 1.0, 130), rng.uniform(0.0, 2.0 * np.pi, 130)
    sine = np.sqrt(1.0 - cosine**2)
    out = np.column_stack([sine * np.cos(turn), sine * np.sin(turn), -cosine])
    # On the outline of the ball, 19 % of whose radius are 86 nm.
    out = np.vstack([out, [-0.55, -0.815, 0.18]])
    height = np.append(rng.normal(0.0, 1.5e-9, 130), 81e-9)
    design = np.column_stack([out, np.ones(len(out)), _quadrics(out)])
    residuals = SimpleNamespace(height=height)
    solution, rows = _SphereResiduals.fit(residuals, design)
    left = height - design @ solution
    assert left[-1] > 60e-9
    np.testing.assert_allclose(rows[:, -1], 0.0, atol=1e-12)
    # 130 points of 1.5 nm tell nine unknowns.
    assert np.std(design[:-1] @ solution) < 1.5e-9
