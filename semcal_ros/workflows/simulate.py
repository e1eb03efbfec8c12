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

"""A recording of the virtual SEM, with its truth."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.files.bags.simulated import write_simulated
from semcal_ros.synthetic import (
    CALIBRATION_MAGNIFICATIONS,
    STAGES,
    TYPICAL_GRID,
    Detector,
    GridFaults,
    RecordingPlan,
    SimulatedStage,
    VirtualMicroscope,
    calibration_plan,
    conditions_of,
    drift_plan,
    drift_preset,
    ladder_plan,
    preset,
    steps_plan,
    truth_of,
    zoom_plan,
)
from semcal_ros.workflows.inputs import (
    OnProgress,
    check_positives,
    count_frames,
    ignore_progress,
)

__all__ = ["MOST_FRAMES", "MOST_VIEWS", "PLAN_KINDS", "plan_recording", "simulate"]

#: Chess grid at many poses; one place under drift; steps of the magnification; a sweep of it; a specimen beyond the
#: grid.
PLAN_KINDS = ("grid", "drift", "steps", "zoom", "ladder")
#: Poses of a grid at each magnification, and frames: ten times those of the longest recordings in use. More are a
#: slip of the hand, and would fill the disk.
MOST_VIEWS, MOST_FRAMES = 1000, 200_000
# Numbers of magnifications of the plans that do not take any number of them.
_MAGNIFICATIONS = {"drift": 1, "zoom": 2, "ladder": 2}
_STAGE = STAGES["one-axis"]


def plan_recording(
    kind: str,
    microscope: VirtualMicroscope,
    detector: Detector | None = None,
    *,
    specimen: str | None = None,
    drift: str | None = None,
    magnifications: Sequence[float] = (),
    views: int = 5,
    frames: int | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = _STAGE,
    grid: GridFaults | None = TYPICAL_GRID,
) -> RecordingPlan:
    """Plan a recording.

    Parameters
    ----------
    kind
        One of :data:`PLAN_KINDS`.
    microscope, detector
        What records.
    specimen
        What is seen, if it is not the grid of the plan ``grid``.
    drift
        Name of the drift of the specimen.
    magnifications
        For ``drift`` one, for ``zoom`` and ``ladder`` the first and the last, else any number; the default is
        that of the plan.
    views
        Number of poses at each magnification (``grid``, ``ladder``).
    frames
        Number of frames, for ``steps`` at each magnification.
    seed
        Seed of poses, specimen and noise.
    stage, grid
        Faults of the stage and of the grid, or None for perfect ones.

    Raises
    ------
    InvalidValueError
        For an unknown kind or name, the wrong number of magnifications, or more views or frames than anyone needs.
    """
    if kind not in PLAN_KINDS:
        raise InvalidValueError(
            f"plan {kind!r}",
            expected="one of " + ", ".join(PLAN_KINDS),
            do=did_you_mean(kind, PLAN_KINDS),
        )
    for name, count, most in (("views", views, MOST_VIEWS), ("frames", frames, MOST_FRAMES)):
        if count is not None and not 1 <= count <= most:
            raise InvalidValueError(f"{name} = {count}", expected=f"1 to {most}")
    chosen = check_positives(magnifications, "magnifications")
    wanted = _MAGNIFICATIONS.get(kind, len(chosen))
    if chosen and len(chosen) != wanted:
        listed = ", ".join(f"{g:g}" for g in chosen)
        raise InvalidValueError(
            f"plan {kind} with magnifications {listed}", expected=f"{wanted} of them, or none"
        )
    if kind == "grid":
        plan = calibration_plan(
            microscope,
            magnifications=sorted(chosen or CALIBRATION_MAGNIFICATIONS),
            views=views,
            detector=detector,
            seed=seed,
            stage=stage,
            grid=grid,
        )
    elif kind == "drift":
        plan = drift_plan(
            microscope,
            magnification=chosen[0] if chosen else 5000.0,
            frames=frames or 48,
            kind=specimen or "gold",
            drift=drift_preset(drift or "settling"),
            detector=detector,
            seed=seed,
            stage=stage,
            grid=grid,
        )
    elif kind == "steps":
        plan = steps_plan(
            microscope,
            magnifications=chosen or (500.0, 2000.0, 8000.0),
            frames=frames or 12,
            kind=specimen or "grid",
            detector=detector,
            seed=seed,
            stage=stage,
            grid=grid,
        )
    elif kind == "ladder":
        first, last = chosen or (4400.0, 100e3)
        plan = ladder_plan(
            microscope,
            first_magnification=first,
            last_magnification=last,
            views=views,
            kind=specimen or "gold",
            detector=detector,
            seed=seed,
            stage=stage,
        )
    else:
        first, last = chosen or (600.0, 6000.0)
        plan = zoom_plan(
            microscope,
            first_magnification=first,
            last_magnification=last,
            frames=frames or 36,
            kind=specimen or "grid",
            detector=detector,
            seed=seed,
            stage=stage,
            grid=grid,
        )
    return plan if drift is None else replace(plan, drift=drift_preset(drift))


def simulate(
    output: str | os.PathLike[str],
    plan: str = "grid",
    *,
    microscope: str = "jsm820",
    specimen: str | None = None,
    drift: str | None = None,
    magnifications: Sequence[float] = (),
    views: int = 5,
    frames: int | None = None,
    size: int = 512,
    bits: int = 8,
    electrons: float | None = None,
    blur_px: float | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = _STAGE,
    grid: GridFaults | None = TYPICAL_GRID,
    overwrite: bool = False,
    on_progress: OnProgress = ignore_progress,
) -> int:
    """Record the virtual SEM to a bag, with ``truth.json`` (SI units) beside it.

    Parameters
    ----------
    output
        Bag to make.
    plan, specimen, drift, magnifications, views, frames, seed, stage, grid
        As for :func:`plan_recording`.
    microscope
        Name of the virtual microscope.
    size
        Width and height of the images, px.
    bits, electrons, blur_px
        Depth of the grey levels, electrons per pixel (0 for no shot noise), and sigma of the beam;
        None for those of the detector.
    overwrite
        Whether to replace an existing bag, once the new one is complete.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Returns
    -------
    The number of frames.

    Raises
    ------
    SemcalError
        For an unknown name or a value out of range, or if the bag exists or cannot be written.
    """
    scope = preset(microscope)
    if size != scope.width:
        scope = scope.with_image_size(size, size)
    detector = Detector(bits=bits)
    if electrons is not None:
        detector = replace(detector, electrons=electrons)
    if blur_px is not None:
        detector = replace(detector, blur_px=blur_px)
    recording = plan_recording(
        plan,
        scope,
        detector,
        specimen=specimen,
        drift=drift,
        magnifications=magnifications,
        views=views,
        frames=frames,
        seed=seed,
        stage=stage,
        grid=grid,
    )
    advance = count_frames(on_progress, "simulating", len(recording))
    write_simulated(
        Path(output),
        recording.frames,
        _render(recording, advance),
        truth_of(recording),
        conditions=conditions_of(scope),
        overwrite=overwrite,
    )
    return len(recording)


def _render(recording: RecordingPlan, advance: Callable[[int], object]) -> Iterator[AnyImage]:
    for index in range(len(recording)):
        yield recording.render(index)
        advance(1)
