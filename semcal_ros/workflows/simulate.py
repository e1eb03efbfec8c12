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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.synthetic import (
    CALIBRATION_MAGNIFICATIONS,
    DRIFTS,
    PRESETS,
    SPECIMEN_KINDS,
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
    make_stage,
    preset,
    steps_plan,
    truth_of,
    zoom_plan,
)
from semcal_ros.workflows.inputs import OnProgress, check_positives, count_frames, ignore_progress
from semcal_ros.workflows.options import OVERWRITE, PROGRESS, Keyword, KeywordsOf, Option

#: Chess grid at many poses; one place under drift; steps of the magnification; a sweep of it; a specimen beyond the
#: grid.
PLAN_KINDS = ("grid", "drift", "steps", "zoom", "ladder")
#: Poses of a grid at each magnification, and frames: ten times those of the longest recordings in use. More are a
#: slip of the hand, and would fill the disk.
MOST_VIEWS, MOST_FRAMES = 1000, 200_000
# Numbers of magnifications of the plans that do not take any number of them.
_MAGNIFICATIONS = {"drift": 1, "zoom": 2, "ladder": 2}
_STAGE = STAGES["one-axis"]


@dataclass(frozen=True)
class SimulationOptions:
    """What is recorded, by which virtual microscope, and how."""

    plan: Annotated[
        str,
        Option(
            "Chess grid at many poses; one place under drift; steps of the magnification; a sweep of it; a specimen "
            "beyond the grid.",
            choices=PLAN_KINDS,
        ),
    ] = "grid"
    microscope: Annotated[
        str, Option("Virtual microscope.", names=("--preset",), choices=sorted(PRESETS))
    ] = "jsm820"
    specimen: Annotated[
        str | None, Option("Specimen of all plans but grid.", choices=SPECIMEN_KINDS)
    ] = None
    drift: Annotated[str | None, Option("Drift of the specimen.", choices=sorted(DRIFTS))] = None
    magnifications: Annotated[
        tuple[float, ...],
        Option(
            "grid, steps: repeat for each; drift: one; zoom, ladder: first and last.",
            names=("--magnification",),
            repeated=True,
            python="The default is that of the plan.",
        ),
    ] = ()
    views: Annotated[int, Option("grid, ladder: poses each.", between=(1, MOST_VIEWS))] = 5
    frames: Annotated[
        int | None,
        Option("drift, zoom: number of frames; steps: of each step.", between=(1, MOST_FRAMES)),
    ] = None
    size: Annotated[int, Option("Width and height.", between=(32, 8192), python="In px.")] = 512
    bits: Annotated[int, Option("Depth of the grey levels.", choices=(8, 16))] = 8
    electrons: Annotated[
        float | None, Option("Electrons per pixel; 0 for no shot noise.", between=(0, None))
    ] = None
    blur_px: Annotated[float | None, Option("Sigma of the beam in px.", between=(0, None))] = None
    seed: Annotated[int, Option("Seed of poses, specimen and noise.", between=(0, None))] = 0
    stage: Annotated[SimulatedStage | None, Keyword("Faults of the stage; None: perfect.")] = _STAGE
    grid: Annotated[GridFaults | None, Keyword("Faults of the grid; None: perfect.")] = TYPICAL_GRID
    overwrite: Annotated[bool, OVERWRITE] = False
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@dataclass(frozen=True)
class FaultOptions:
    """Faults of stage, scan and grid, as a user states them."""

    stage: Annotated[
        str,
        Option(
            "One tilt axis, which says its tilt; or tilts in every direction, as no stage does.",
            choices=tuple(STAGES),
        ),
    ] = "one-axis"
    eucentric_error_m: Annotated[
        float | None,
        Option(
            "How far the axis of a one-axis stage misses the specimen.  "
            f"[default: {1e6 * _STAGE.miss_m[0]:g}um]",
            kind="length or 0",
        ),
    ] = None
    repeatability: Annotated[
        float,
        Option("1-sigma of the scale, each time that a magnification is set.", kind="ratio"),
    ] = _STAGE.scale_sigma
    grid_stretch: Annotated[float, Option("Difference of the grid's axes.", kind="ratio")] = (
        TYPICAL_GRID.stretch
    )
    grid_shear: Annotated[
        float, Option("How far the grid's axes are from a right angle.", kind="ratio")
    ] = TYPICAL_GRID.shear
    grid_bow_m: Annotated[
        float,
        Option(
            "Radius to which the grid is bowed; 0 for a flat one.",
            kind="length or 0",
            metavar="RADIUS",
        ),
    ] = 1.0 / TYPICAL_GRID.curvature
    grid_wave: Annotated[
        float, Option("Amplitude of a wave in its rows, of a square.", kind="ratio")
    ] = TYPICAL_GRID.wave
    grid_squares: Annotated[float, Option("1-sigma of each size of its squares.", kind="ratio")] = (
        TYPICAL_GRID.squares_sigma
    )
    line_jitter_px: Annotated[
        float, Option("1-sigma of the shift of each scan line in px.", between=(0, None))
    ] = _STAGE.line_jitter_px

    def make_stage(self) -> SimulatedStage:
        """Return the stage; raises :class:`InvalidValueError`."""
        return make_stage(
            self.stage,
            eucentric_error_m=self.eucentric_error_m,
            repeatability=self.repeatability,
            line_jitter_px=self.line_jitter_px,
        )

    def make_grid(self) -> GridFaults:
        """Return the grid; raises :class:`InvalidValueError`."""
        return replace(
            TYPICAL_GRID,
            stretch=self.grid_stretch,
            shear=self.grid_shear,
            curvature=1.0 / self.grid_bow_m if self.grid_bow_m > 0.0 else 0.0,
            wave=self.grid_wave,
            squares_sigma=self.grid_squares,
        )


def plan_recording(
    microscope: VirtualMicroscope,
    options: SimulationOptions | None = None,
    detector: Detector | None = None,
) -> RecordingPlan:
    """Plan a recording.

    Parameters
    ----------
    microscope, detector
        What records, in place of those of the options.
    options
        What is recorded.

    Raises
    ------
    InvalidValueError
        For an unknown plan or name, the wrong number of magnifications, or more views or frames than anyone needs.
    """
    chosen_options = options or SimulationOptions()
    kind, specimen, drift = chosen_options.plan, chosen_options.specimen, chosen_options.drift
    magnifications, views = chosen_options.magnifications, chosen_options.views
    frames, seed = chosen_options.frames, chosen_options.seed
    stage, grid = chosen_options.stage, chosen_options.grid
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


@KeywordsOf(SimulationOptions)
def simulate(output: str | os.PathLike[str], options: SimulationOptions) -> int:
    """Record the virtual SEM to a bag, with ``truth.json`` (SI units) beside it.

    Returns
    -------
    The number of frames.

    Raises
    ------
    SemcalError
        For an unknown name or a value out of range, or if the bag exists or cannot be written.
    """
    return record_simulation(output, options)


def record_simulation(output: str | os.PathLike[str], options: SimulationOptions) -> int:
    """As :func:`simulate`, for options that are an object already."""
    scope = preset(options.microscope)
    if options.size != scope.width:
        scope = scope.with_image_size(options.size, options.size)
    detector = Detector(bits=options.bits)
    if options.electrons is not None:
        detector = replace(detector, electrons=options.electrons)
    if options.blur_px is not None:
        detector = replace(detector, blur_px=options.blur_px)
    recording = plan_recording(scope, options, detector)
    advance = count_frames(options.on_progress, "simulating", len(recording))
    write_simulated(
        Path(output),
        recording.frames,
        _render(recording, advance),
        truth_of(recording),
        conditions=conditions_of(scope),
        overwrite=options.overwrite,
    )
    return len(recording)


def _render(recording: RecordingPlan, advance: Callable[[int], object]) -> Iterator[AnyImage]:
    for index in range(len(recording)):
        yield recording.render(index)
        advance(1)
