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

"""The bending cantilever: its geometry in rendered frames, and the plan of the experiment."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import NOISE_FREE, Drift, preset
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.render import render_reflectivity
from semcal_ros.synthetic.specimens.cantilever import CantileverScene, cantilever_plan
from semcal_ros.synthetic.thresholds import CANTILEVER_MAGNIFICATIONS, CANTILEVER_PUSHES

# A plain beam: no texture, no rims.
PLAIN = CantileverScene(background=0.0, rim=0.0, beam=1.0, holder=1.0, pusher=0.5)


@pytest.mark.parametrize("shape", ["beam", "parabola"])
def test_the_arc_length_is_conserved(shape):
    scene = replace(PLAIN, deflection_m=2e-6, shape=shape)
    x = np.linspace(0.0, scene.end_x_m, 4001)
    y = scene.deflection_m * scene.bending(x / scene.end_x_m)
    length = np.sum(np.hypot(np.diff(x), np.diff(y)))
    # What is left is of fourth order in the slope: 0.1^4 of the length at most.
    assert length == pytest.approx(scene.length_m, abs=1e-4 * scene.length_m)
    assert scene.length_m - scene.end_x_m > 0.05e-6
    assert y[-1] == pytest.approx(2e-6)


def test_a_beam_is_clamped_and_straight_beyond_its_load():
    bending = replace(PLAIN, pusher_m=(28e-6, 40e-6)).bending(np.linspace(0.0, 1.0, 1001))
    slope = np.diff(bending) * 1000
    assert bending[0] == 0.0 and slope[0] == pytest.approx(0.0, abs=2e-3)
    assert np.ptp(slope[810:]) < 1e-9  # no moment beyond the load at 0.8
    assert slope[100] < slope[400] < slope[790]


def test_the_rendered_beam_lies_where_the_truth_says():
    scope = replace(preset("ideal"), display_width_m=0.4).with_image_size(256, 256)
    scene = replace(PLAIN, deflection_m=0.9e-6)
    g = 7000.0
    pixel_m = scope.nominal_pixel_size_m(g)
    pose = Pose.flat((-18e-6, 0.3e-6, 0.0))
    seen = render_reflectivity(scope, scene, pose, g)
    camera = scope.camera_at(g)
    for arc in (5e-6, 15e-6, 25e-6, 32e-6):
        column = round(float(camera.project_ideal([[arc - 18e-6, 0.0, 0.0]])[0, 0]))
        x = float(camera.sem_from_ideal([[column, 0.0]])[0, 0]) + 18e-6
        profile = seen[:, column].astype(float)
        middle = float(profile @ np.arange(256) / profile.sum())
        y = scene.deflection_m * float(scene.bending(np.array([x / scene.end_x_m]))[0]) + 0.3e-6
        expected = float(camera.project_ideal([[0.0, y, 0.0]])[0, 1])
        # The share of a pixel counts at its centre: 1/8 px over the width at each edge.
        assert middle == pytest.approx(expected, abs=2 * 0.125 / (scene.width_m / pixel_m))
        assert profile.sum() * pixel_m == pytest.approx(scene.width_m, rel=2e-3)
    row = seen[round(float(camera.project_ideal([[0.0, 1.2e-6, 0.0]])[0, 1]))].astype(float)
    end = float(camera.project_ideal([[scene.end_x_m - 18e-6, 0.0, 0.0]])[0, 0])
    assert row.sum() == pytest.approx(end + 0.5, abs=5e-3)  # holder and beam from the left border


def test_the_pusher_touches_and_does_not_cover_the_beam():
    scene = replace(PLAIN, deflection_m=250e-9, gap_m=0.0)
    x = np.linspace(scene.pusher_m[0] + 1e-9, scene.end_x_m - 1e-9, 50)
    line = scene.deflection_m * scene.bending(x / scene.end_x_m) - 0.5 * scene.width_m
    footprint = 1e-12 * np.eye(2)
    x, line = x[None], line[None]
    inside = scene.reflectivity(x, line + 1e-10, footprint)
    outside = scene.reflectivity(x, line - 25e-9, footprint)
    assert np.allclose(inside, 1.0)
    assert np.allclose(outside, 0.5)  # within 25 nm of the edge all along
    free = replace(scene, deflection_m=0.0, gap_m=600e-9)
    assert np.all(free.reflectivity(x, -0.5 * scene.width_m - 25e-9 + 0 * x, footprint) < 0.1)


def test_impossible_beams_are_refused():
    with pytest.raises(InvalidValueError, match="finite sizes above 0"):
        CantileverScene(length_m=0.0)
    with pytest.raises(InvalidValueError, match="tenth of the length"):
        CantileverScene(deflection_m=5e-6)
    with pytest.raises(InvalidValueError, match="without frames"):
        cantilever_plan(preset("ideal"), frames_per_pose=0)


def test_the_plan_is_the_experiment_of_the_paper():
    drift = Drift(velocity_m_s=(2e-9, -1e-9))
    scope = replace(preset("jsm820"), display_width_m=0.4)
    plan = cantilever_plan(scope, drift=drift, detector=NOISE_FREE)
    assert len(plan) == 33
    assert len(CANTILEVER_PUSHES) == 11 and int(np.argmax(CANTILEVER_PUSHES)) == 6
    assert [f.magnification for f in plan.frames[:3]] == list(CANTILEVER_MAGNIFICATIONS)
    frames = json.loads(json.dumps(plan.truth()))["frames"]
    assert max(f["deflection_m"] for f in frames) == pytest.approx(250e-9)
    assert [f["deflection_m"] for f in frames[:3] + frames[-3:]] == [0.0] * 6
    times = [f["start_time_s"] for f in frames]
    assert min(np.diff(times)) >= scope.timing.acquisition_time_s
    centre = times[-1] + scope.timing.centre_offset_s
    assert frames[-1]["drift_m"] == pytest.approx([2e-9 * centre, -1e-9 * centre])
    for frame in frames:  # both ends are in view
        for end in ("base_px", "end_px"):
            assert np.all(np.array(frame[end]) > 20) and np.all(np.array(frame[end]) < 492)


def test_views_of_one_end():
    for view, seen, hidden in (("end", "end_px", "base_px"), ("base", "base_px", "end_px")):
        plan = cantilever_plan(preset("jsm820"), view=view, pushes=(0.0,))
        for frame in plan.truth()["frames"]:
            assert np.all(np.array(frame[seen]) > 20) and np.all(np.array(frame[seen]) < 492)
            assert not (0 < frame[hidden][0] < 512)


def test_frames_differ_by_noise_and_drift_only():
    scope = preset("ideal").with_image_size(64, 64)
    plan = cantilever_plan(scope, pushes=(0.0, 0.0), magnifications=(6450.0,), detector=NOISE_FREE)
    assert np.array_equal(plan.render(0), plan.render(1))
    moved = cantilever_plan(
        scope,
        pushes=(0.0, 0.0),
        magnifications=(6450.0,),
        detector=NOISE_FREE,
        drift=Drift(velocity_m_s=(200e-9, 0.0)),
    )
    assert not np.array_equal(moved.render(0), moved.render(1))
