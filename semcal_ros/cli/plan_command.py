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

"""``semcal plan``."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import PATH, config_option, json_option, options_of
from semcal_ros.cli.output import echo_json, echo_table
from semcal_ros.core.calibration.judgement.plan import ViewPlan, plan_views
from semcal_ros.core.calibration.judgement.thresholds import (
    DEFAULT_AGEING,
    PLANNED_DIRECTIONS_RAD,
    PLANNED_TILTS_RAD,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.acquisition import PlannedStep, plan_ladder
from semcal_ros.core.wording import counted
from semcal_ros.workflows.inputs import resolve_config
from semcal_ros.workflows.options import SQUARES, Option


@dataclass(frozen=True)
class PlanOptions:
    """What the views are to reach, and what is assumed until they are recorded."""

    target: Annotated[
        float | None,
        Option(
            "1-sigma of nm per pixel to reach at all calibrated magnifications, such as 0.1%.",
            kind="ratio",
        ),
    ] = None
    visits: Annotated[int, Option("Propose at most so many visits.", between=(1, 30))] = 10
    ageing: Annotated[
        float,
        Option(
            "1-sigma of a relative change of the scale until the views are recorded, as of `semcal update`.",
            kind="ratio",
        ),
    ] = DEFAULT_AGEING
    squares: Annotated[tuple[float, ...] | None, SQUARES] = None
    last: Annotated[
        float | None,
        Option(
            "Instead: pictures of a specimen with which `semcal extend` reaches this magnification, such as 100000x.",
            kind="magnification",
            names=("--extend",),
        ),
    ] = None


@click.command("plan")
@click.argument("calibration", type=PATH)
@options_of(PlanOptions)
@config_option
@json_option
def command(calibration: Path, options: PlanOptions, config: str, as_json: bool) -> None:
    """Which views to record next for CALIBRATION, so that nm per pixel becomes more certain, or reaches farther.

    Record them, and use them with `semcal update`; those of --extend with `semcal extend`.

    \b
    Example:
      semcal plan cal.yaml --target 0.1%
      semcal plan cal.yaml --extend 100000x
    """
    target, last = options.target, options.last
    if (target is None) == (last is None):
        raise InvalidValueError(
            "neither --target nor --extend" if target is None else "--target and --extend",
            expected="one of the two",
        )
    model = Calibration.load(calibration)
    if last is not None:
        steps = plan_ladder(model, last)
        if as_json:
            echo_json([asdict(step) for step in steps])
        else:
            _echo_ladder(steps)
        return
    assert target is not None
    microscope = resolve_config(config, model)
    plan = plan_views(
        model,
        target,
        squares_m=options.squares or microscope.squares_m,
        most_visits=options.visits,
        ageing=options.ageing,
    )
    if as_json:
        echo_json(asdict(plan))
    else:
        _echo_plan(plan, target)


def _echo_ladder(steps: tuple[PlannedStep, ...]) -> None:
    click.echo(
        "over one place of a flat, textured specimen, untilted; at each magnification a picture in the middle, two that"
    )
    click.echo("are moved by x, y um, and one in the middle with the scan turned:")
    rows = []
    for step in steps:
        moves = [f"{1e6 * x:+.3g}, {1e6 * y:+.3g}" for x, y in step.moves_m[1:]]
        rows.append(
            [
                f"{step.magnification:g}",
                f"{1e6 * step.field_m:.3g}",
                *moves,
                f"{math.degrees(step.turn_rad):+.0f} deg",
            ]
        )
    echo_table(["magnification", "field um", "first move", "second move", "turned"], rows)
    count = sum(len(step.moves_m) + 1 for step in steps)
    click.echo(f"{counted(count, 'picture')}; set each magnification once, in this order")


def _echo_plan(plan: ViewPlan, target: float) -> None:
    click.echo(f"now: nm per px known to {100.0 * plan.largest:.3f} % at {plan.at:.0f}x, the worst")
    if plan.visits:
        angles = PLANNED_DIRECTIONS_RAD if plan.is_grating else PLANNED_TILTS_RAD
        degrees = ", ".join(f"{math.degrees(angle):.0f}" for angle in angles)
        click.echo(
            f"visit in this order, each with untilted views, the grating turned to {degrees} degrees:"
            if plan.is_grating
            else f"visit in this order, each with views tilted by {degrees} degrees, differently turned:"
        )
        echo_table(
            [
                "magnification",
                "pitch um" if plan.is_grating else "squares um",
                "then %",
                "worst at",
            ],
            [
                [
                    f"{v.magnification:.0f}",
                    f"{1e6 * v.square_m:g}",
                    f"{100.0 * v.largest:.3f}",
                    f"{v.at:.0f}",
                ]
                for v in plan.visits
            ],
        )
    if plan.reached:
        click.echo(f"{counted(len(plan.visits), 'visit')}: {100.0 * target:g} % is met")
    elif plan.floor >= target:
        click.echo(
            f"no number of views meets {100.0 * target:g} %: repeatability, squares and height alone are "
            f"{100.0 * plan.floor:.3f} %; `semcal at --budget` shows which"
        )
    else:
        click.echo(
            f"{100.0 * target:g} % is not met with {counted(len(plan.visits), 'visit')}; allow more with --visits"
        )
