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

"""Drift of a background that little is left of."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from semcal_ros.applications.cantilever import background_drift
from semcal_ros.applications.cantilever.background_drift import (
    Background,
    _estimate_rough_drift,
    _find_texture,
    follow_background,
)
from semcal_ros.applications.cantilever.plane import Axis, PlaneMap
from semcal_ros.applications.cantilever.series import (
    SeriesSettings,
    _collect_notes,
    _is_tied,
    _name_lost_regions,
)
from semcal_ros.applications.cantilever.undeformed import measure_undeformed_beam
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.registration.failures import MatchFailure

SIZE = 384


@pytest.mark.parametrize("turned", [False, True])
def test_the_texture_is_sought_in_what_stays_in_view_and_uncovered(turned: bool) -> None:
    weight = np.ones((SIZE, SIZE), np.float32)
    weight[60:, :] = 0.0
    weight[:30, 190:200] = 0.0
    if turned:
        weight = np.ascontiguousarray(weight.T)
    left, top, right, bottom = _find_texture(weight, 3.0)
    assert weight[top - 3 : bottom + 3, left - 3 : right + 3].min() == 1.0
    assert min(left, top) >= 3
    assert max(right, bottom) <= SIZE - 3
    # 30 px are free along the whole side, and 60 px along half of it; 4 px are left out at each border.
    assert (right - left) * (bottom - top) > 0.6 * 52 * 180
    assert _find_texture(np.zeros((SIZE, SIZE), np.float32), 0.0) is None


@pytest.mark.parametrize("first_look", [True, False])
def test_drift_beside_a_wide_beam(first_look: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A smooth cover over the middle loses no frame, and pulls none if the first look at the drift has failed."""
    if not first_look:
        blind = lambda images, _beam: (np.zeros((len(images), 2)), ())  # noqa: E731
        monkeypatch.setattr(background_drift, "_estimate_rough_drift", blind)
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((SIZE + 40, SIZE + 40)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.5)
    texture *= 8.0 / texture.std()
    y, x = np.mgrid[:SIZE, :SIZE]
    frames, drift_px = [], np.array([[0.0, 0.0], [2.3, -1.2], [3.9, -2.6], [5.2, -3.1]])
    for k, (dx, dy) in enumerate(drift_px):
        matrix = np.array([[1.0, 0.0, 20.0 - dx], [0.0, 1.0, 20.0 - dy]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        frame = 70.0 + cv2.warpAffine(texture, matrix, (SIZE, SIZE), flags=flags)
        frame[(np.abs(y - 192 - dy - 3 * k) < 120) & (x < 360 + dx)] = 170.0
        frame += rng.normal(0.0, 8.0, frame.shape)
        frames.append(np.clip(np.rint(frame), 0, 255).astype(np.uint8))
    plane = PlaneMap(ScanCamera.nominal(8890.0, SIZE, SIZE, 0.12), None)
    ends = plane.sem_of(np.array([[0.0, 192.0], [360.0, 192.0]]))
    length_m = float(np.hypot(*(ends[1] - ends[0])))
    direction = (ends[1] - ends[0]) / length_m
    half_m = 120.0 * plane.pixel_m
    axis = Axis(ends[0], direction, half_m, (0.0, length_m), False, True)
    times_s = [20.0 * k for k in range(len(frames))]
    path = follow_background(frames, times_s, plane, axis, 12.0 * plane.pixel_m).path
    assert path.trusted.all(), [u.reason for u in path.updates]
    # The contrast is as large as the noise, and a third of the image counts: 0.07 px RMS along y over eight seeds, 1.2
    # stated sigmas.
    np.testing.assert_allclose(path.drift_px, drift_px, atol=0.2)
    sigma_px = np.array([update.sigma_px for update in path.updates])
    assert np.all(np.abs(path.drift_px - drift_px)[1:] < 4.0 * sigma_px[1:])


@pytest.mark.parametrize(
    ("accepted", "reference", "tied"),
    [
        ([1, 1, 0], (0,), [1, 1, 0]),
        # Tracking began with the second frame: nothing is known of the first.
        ([0, 1, 1], (0,), [0, 0, 0]),
        ([0, 1, 1], (1,), [0, 1, 1]),
        ([1, 0, 1], (0, 1), [0, 0, 0]),
    ],
)
def test_a_frame_is_tied_to_reference_frames_that_have_a_drift(
    accepted: list[int], reference: tuple[int, ...], tied: list[int]
) -> None:
    updates = [SimpleNamespace(accepted=bool(a), restarted=False) for a in accepted]
    path = DriftPath(updates)  # type: ignore[arg-type]
    assert [_is_tied(path, k, reference) for k in range(3)] == [bool(t) for t in tied]


@pytest.mark.parametrize(
    ("base_seen", "said", "unsaid"),
    [
        (
            True,
            ["they rest on the base alone"],
            ["the base is out of view", "neither drift nor base"],
        ),
        (
            False,
            ["the base is out of view", "neither drift nor base holds them"],
            ["rest on the base"],
        ),
    ],
)
def test_a_frame_without_drift_rests_on_the_base_only_where_it_is_in_view(
    base_seen: bool, said: list[str], unsaid: list[str]
) -> None:
    """What the notes say of the base, all of them together."""
    along, across = (
        v.ravel() for v in np.meshgrid(60e-9 * np.arange(333), 60e-9 * np.arange(-50, 50))
    )
    grey = np.where((np.abs(across) < 1.5e-6) & (along < 18e-6), 150.0, 50.0)
    first = 3e-6 if base_seen else 0.0
    grey[along < first] = 150.0
    rough = Axis(np.zeros(2), np.array([1.0, 0.0]), 1.5e-6, (first, 18e-6), base_seen, True)
    undeformed = measure_undeformed_beam(rough, [(along, across, grey)], 15e-6, 60e-9)
    updates = [
        SimpleNamespace(accepted=k < 2, restarted=False, reason=reason)
        for k, reason in enumerate(["", "", "correlation 0.12 of 0.5", "correlation 0.2 of 0.5"])
    ]
    background = Background(DriftPath(updates), np.zeros((2, 2), np.float32))  # type: ignore[arg-type]
    frames = [SimpleNamespace(deflection_m=0.0)] * 4
    settings = SeriesSettings(15e-6)
    notes = _collect_notes(undeformed, frames, background, (0,), settings)  # type: ignore[arg-type]
    told = "\n".join(notes)
    assert "no drift in 2 of 4 frames (correlation \u2026 of \u2026)" in told
    assert all(text in told for text in said), told
    assert not any(text in told for text in unsaid), told


def test_regions_of_the_ground_are_judged_one_by_one() -> None:
    """One region without structure, and one that moves by itself."""
    rng = np.random.default_rng(5)
    size, drift_px = 256, 2.0
    texture = cv2.GaussianBlur(
        rng.standard_normal((size + 20, size + 20)).astype(np.float32), (0, 0), 2.0
    )
    texture *= 20.0 / texture.std()
    frames = []
    for k in range(3):
        at = 10 - round(drift_px * k)
        frame = 100.0 + texture[10 : 10 + size, at : at + size]
        frame[:64, :64] = 100.0
        frame[192:, 192:] = 100.0 + texture[202 + 5 * k : 266 + 5 * k, 202:266]
        frames.append((frame + rng.normal(0.0, 2.0, frame.shape)).astype(np.float32))
    shifts, regions = _estimate_rough_drift(frames, np.zeros((size, size), bool))
    np.testing.assert_allclose(shifts, [[0.0, 0.0], [2.0, 0.0], [4.0, 0.0]], atol=0.1)
    lost = {region.box_px: region for region in regions if region.lost}
    assert set(lost) == {(0, 0, 64, 64), (192, 192, 256, 256)}
    assert "moves against the others by" in lost[192, 192, 256, 256].reason
    assert lost[192, 192, 256, 256].failures[1].status is MatchFailure.OUTLIER
    blank = lost[0, 0, 64, 64].failures[0]
    assert blank is not None and blank.status is not MatchFailure.OUTLIER
    (note,) = _name_lost_regions(Background(DriftPath([]), np.zeros((2, 2), np.float32), regions))
    assert note.startswith("2 of 16 regions of the ground could not be followed in most frames: ")
    assert "x 192 to 256, y 192 to 256 px (moves against the others by \u2026 px)" in note
    assert f"x 0 to 64, y 0 to 64 px ({lost[0, 0, 64, 64].reason})" in note
