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

"""Small streams, tracked as they come: scenes of ``benchmarks.drift.scenes``, and streams that are drawn here, line by
line, of gold at its place at each time. Errors are in px.

One has zooms, one a pause, some torn frames, one lines that wander as one over the frequency. Of one that is
sheared the time of a pass is estimated, in s; of a body its own motion, in px per frame; of turned scans the drift
within them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.frame_time import estimate_frame_time
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.scan_pairs import TurnedScan, measure_scan_pairs
from semcal_ros.core.drift.tracker import DriftTracker

SCENES = (
    "gold",
    "gold at 2 electrons",
    "charging gold",
    "gold and a stage move",
    "gold and a move within a frame",
    "fast gold",
    "sparse",
    "scratches",
    "lattice",
    "tool over gold",
    "tool over sparse",
    "two tools",
    "pushed particle",
    "shadow",
    "data bar",
    "hum over gold",
    "columns over ridges",
    "spots and cross-hair",
)
SIZE, FRAMES, SEED = 192, 12, 100
WRONG_PX, WRONG_SIGMAS = 0.1, 3.0
PX_M, SCALE_SIGMA = 1e-7, 0.003
SHEARED_FRAMES, PASS_S = 30, 0.8
BODY_FRAMES, BODY_STEP_PX = 18, 2.5
CHANGED_FRAMES = 30
# The ends of turned scans are told by few tiles.
TURNED_SIZE, INNER = 320, np.linspace(0.2, 0.8, 13)

Floats = NDArray[np.float64]
#: Times (...) to places (..., 2) in px.
Path = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Stream:
    """Frames, (n, 2) their drift in px of the first magnification, their times, and (n,) zooms; whether to look at the
    path with hindsight, at the time of a pass, or at the own motion of a body.
    """

    frames: list[NDArray[np.uint8]]
    drift_px: Floats
    times_s: Floats
    zooms: Floats | None = None
    look_at: str = "drift"


@dataclass(frozen=True)
class Turned:
    """Two scans, the second turned by 90 degrees, and the drift (2, n, 2) in px at :data:`INNER` parts of each."""

    scans: list[NDArray[np.uint8]]
    drift_px: Floats


def draw() -> dict[str, Any]:
    """Draw the frames."""
    # Not where they are tracked: each run imports what it needs.
    from benchmarks.drift import scenes

    # Of the scenes' own pictures, smaller ones, and fewer.
    scenes.SIZE, scenes.FRAMES = SIZE, FRAMES
    seconds = np.arange(float(FRAMES))
    cases: dict[str, Any] = {}
    for name in SCENES:
        frames, drift, _ = scenes.draw(scenes.KINDS[name], SEED)
        cases[name] = Stream(frames, drift, seconds)
    scenes.FRAMES = CHANGED_FRAMES
    for name in ("gold that changes", "ridges that change"):
        frames, drift, _ = scenes.draw(scenes.KINDS[name], SEED + 1)
        cases[name] = Stream(frames, drift, np.arange(float(CHANGED_FRAMES)))
    scenes.FRAMES = FRAMES
    move = cases["gold and a stage move"]
    cases["gold and a stage move in hindsight"] = replace(move, look_at="hindsight")
    torn = list(cases["gold"].frames)
    for k in (4, 8):
        torn[k] = np.concatenate([torn[k][: SIZE // 2], torn[k - 1][SIZE // 2 :]])
    cases["torn frames"] = replace(cases["gold"], frames=torn)

    ground = spline_filter(scenes.gold(np.random.default_rng(SEED)), order=3, mode="grid-wrap")
    rng = np.random.default_rng(SEED + 1)

    def scan(
        start_s: float,
        path: Path,
        pass_s: float = 0.0,
        zoom: float = 1.0,
        *,
        side: int = SIZE,
        turned: bool = False,
    ) -> Floats:
        """What the beam sees, line by line; turned by 90 degrees, the lines run along y."""
        y, x = (np.indices((side, side)) - 0.5 * (side - 1)) / zoom
        at_px = path(start_s + pass_s * (np.arange(side) + 0.5) / side)
        if turned:
            x, y = y, -x
        middle = 0.5 * len(ground)
        places = [y - at_px[:, 1:] + middle, x - at_px[:, :1] + middle]
        return np.asarray(
            map_coordinates(ground, places, order=3, mode="grid-wrap", prefilter=False)
        )

    def count(picture: Floats) -> NDArray[np.uint8]:
        counted = rng.poisson(60.0 * np.clip(picture, 0.0, None)) / 60.0
        return np.clip(np.rint(200.0 * counted + 10.0), 0, 255).astype(np.uint8)

    def slow(t: Floats) -> Floats:
        return np.stack([0.4 * t, -0.3 * t + 0.5 * np.sin(t / 4.0)], axis=-1)

    def wandering(t: Floats) -> Floats:
        return np.stack([4.0 * np.sin(t / 3.0), 4.0 * np.cos(t / 4.0) + np.sin(t)], axis=-1)

    zooms = np.repeat([1.0, 1.4, 1.05, 1.0], FRAMES // 4)
    # At each change the scale misses by a few thousandths, which the cameras do not say.
    missed = zooms * np.repeat([1.0, 1.003, 0.998, 1.001], FRAMES // 4)
    frames = [count(scan(t, slow, 0.0, zoom)) for t, zoom in zip(seconds, missed, strict=True)]
    cases["zooms"] = Stream(frames, slow(seconds), seconds, zooms)
    paused = np.where(seconds < FRAMES // 2, seconds, seconds + 100.0)
    wait = np.where(seconds < FRAMES // 2, 0.0, 3.0)[:, None]
    frames = [
        count(scan(t, lambda t, w=w: slow(t) + w)) for t, w in zip(seconds, wait, strict=True)
    ]
    cases["a pause"] = Stream(frames, slow(seconds) + wait, paused)
    bends = [_wander_in_lines(rng) for _ in seconds]
    frames = [
        count(scan(0.0, lambda _, t=t, bend=bend: slow(np.full(SIZE, t)) + bend))
        for t, bend in zip(seconds, bends, strict=True)
    ]
    means = np.array([bend.mean(axis=0) for bend in bends])
    cases["lines that wander"] = Stream(frames, slow(seconds) + means, seconds)
    seconds = np.arange(float(SHEARED_FRAMES))
    frames = [count(scan(t, wandering, PASS_S)) for t in seconds]
    cases["time of a pass"] = Stream(frames, wandering(seconds), seconds, None, "pass")
    seconds = np.arange(float(BODY_FRAMES))
    rough = spline_filter(0.7 + 0.3 * scenes.gold(rng), order=3, mode="grid-wrap")
    frames = [count(_with_body(scan(t, slow), rough, 20.0 + BODY_STEP_PX * t)) for t in seconds]
    cases["own motion"] = Stream(frames, slow(seconds), seconds, None, "body")
    paths: list[Path] = [lambda t: slow(6.0 * t), lambda t: slow(6.0 + 6.0 * t**2)]
    scans = [scan(0.0, path, 1.0, side=TURNED_SIZE, turned=bool(k)) for k, path in enumerate(paths)]
    drift = [path(INNER) for path in paths]
    cases["turned scans"] = Turned([count(one) for one in scans], np.array(drift))
    return cases


def _wander_in_lines(rng: np.random.Generator) -> Floats:
    """(SIZE, 2) displacements of the lines of a frame, with a power of one over the frequency."""
    frequency = np.fft.rfftfreq(SIZE, 1.0 / SIZE)[1:, None]
    modes = rng.normal(size=(len(frequency), 2, 2)) @ [1.0, 1.0j] / np.sqrt(frequency)
    return np.asarray(0.05 * SIZE * np.fft.irfft(np.pad(modes, ((1, 0), (0, 0))), SIZE, axis=0))


def _with_body(picture: Floats, rough: Floats, left: float) -> Floats:
    """The same with a rough disc whose left edge is at a column."""
    y, x = np.indices(picture.shape)
    inside = np.clip(36.5 - np.hypot(x - left - 36.0, y - 96.0), 0.0, 1.0)
    moved = map_coordinates(rough, [y, x - left], order=3, mode="grid-wrap", prefilter=False)
    return np.asarray(picture * (1.0 - inside) + moved * inside)


def run(case: Stream | Turned) -> Answer:
    """Track a stream, or compare turned scans."""
    return _compare(case) if isinstance(case, Turned) else _track(case)


def _camera(zoom: float) -> ScanCamera:
    """One without distortion, whose scale may miss."""
    camera = ScanCamera.nominal(1000.0 * zoom, SIZE, SIZE, 1000.0 * SIZE * PX_M)
    covariance = np.zeros((len(camera.names),) * 2)
    covariance[0, 0] = (SCALE_SIGMA * camera.m) ** 2
    return replace(camera, covariance=covariance)


def _track(case: Stream) -> Answer:
    start = time.process_time()
    history = DriftHistory() if case.look_at in ("hindsight", "pass") else None
    tracker = DriftTracker(history=history)
    cameras: list[ScanCamera | None] = [None] * len(case.frames)
    unit = 1.0
    if case.zooms is not None:
        cameras, unit = [_camera(zoom) for zoom in case.zooms.tolist()], 1.0 / PX_M
    frames = zip(case.frames, case.times_s, cameras, strict=True)
    updates = [tracker.update(frame, float(t), camera) for frame, t, camera in frames]
    estimate = None
    if history is not None:
        path = history.smooth()
        updates = list(path.updates)
        if case.look_at == "pass":
            estimate = estimate_frame_time(path)
    seconds = time.process_time() - start
    accepted = np.array([u.accepted for u in updates])
    found = np.array([u.drift_m for u in updates]) * unit
    covariances = np.array([u.covariance for u in updates])
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :2]) * unit
    motions = [u.own_motion for u in updates if u.own_motion is not None]
    own = [np.append(m.velocity_m_s, np.diag(m.covariance)) for m in motions]
    parted = sum(u.moving is not None for u in updates)
    decision = f"{int(accepted.sum())} tracked, {parted} parted"
    used = accepted.copy()
    used[0] = False
    error, sigma = (found - case.drift_px)[used], sigmas[used]
    timed: list[float] = []
    if estimate is not None:
        timed = [estimate.frame_time_s, estimate.sigma_s]
        error, sigma = np.array([[timed[0] - PASS_S]]), np.array([[timed[1]]])
        decision += f", {'observable' if estimate.observable else estimate.reason}"
    elif case.look_at == "body":
        decision += f", {len(own)} with a motion of its own"
        if own:
            error = np.array(own)[:, :2] - [BODY_STEP_PX, 0.0]
            sigma = np.sqrt(np.array(own)[:, 2:])
    bits = digest_of(found, covariances, *own, timed, "".join(u.status.name for u in updates))
    return _answer(decision, int(accepted.sum()), error, sigma, bits, seconds)


def _compare(case: Turned) -> Answer:
    start = time.process_time()
    found = measure_scan_pairs([TurnedScan(scan, k) for k, scan in enumerate(case.scans)])
    seconds = time.process_time() - start
    measured = np.array([found.at(k, INNER) for k in range(len(case.scans))])
    sigma = np.array(
        [
            np.stack([np.interp(INNER, found.progress, column) for column in one.T], axis=-1)
            for one in found.sigma_px
        ]
    )
    # Their zero is the mean over the first scan.
    truth = case.drift_px - case.drift_px[0].mean(axis=0)
    error = measured - truth - (measured[0] - truth[0]).mean(axis=0)
    bits = digest_of(found.displacement_px, found.covariance_px2)
    return _answer(
        f"{len(found.progress)} knots", found.tiles, error[1].copy(), sigma[1], bits, seconds
    )


def _answer(
    decision: str, count: int, error: Floats, sigma: Floats, bits: str, seconds: float
) -> Answer:
    if not len(error):
        return Answer(decision, count, digest=bits, seconds=seconds)
    with np.errstate(divide="ignore", invalid="ignore"):
        score = np.where(sigma > 0.0, np.abs(error) / sigma, 0.0)
    wrong = np.any((np.abs(error) > WRONG_PX) & (score > WRONG_SIGMAS), axis=1)
    return Answer(
        decision,
        count,
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
        float(np.sqrt(np.mean(score**2))),
        int(wrong.sum()),
        bits,
        seconds,
    )
