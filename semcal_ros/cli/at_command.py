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

"""``semcal at``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import PATH, json_option, options_of
from semcal_ros.cli.output import echo_json, echo_notes, echo_table
from semcal_ros.core.camera.records import NOT_RECORDED
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.term_sizes import has_terms, measure_along_axes
from semcal_ros.core.camera.uncertainty import (
    UncertaintyBudget,
    budget_of_length,
    budget_of_pixel_size,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.workflows.describe_camera import describe_camera
from semcal_ros.workflows.options import Option


@dataclass(frozen=True)
class AtOptions:
    """What is told, instead of the camera."""

    budget: Annotated[
        bool, Option("What the uncertainty of nm per pixel consists of, instead.")
    ] = False
    length_m: Annotated[
        float | None,
        Option("With --budget: that of a length in the image, such as 10um.", kind="length"),
    ] = None
    edge_sigma_px: Annotated[
        float,
        Option(
            "With --length: 1-sigma of the position of each of its ends, px.",
            between=(0.0, None),
            metavar="PX",
        ),
    ] = 0.5
    height_m: Annotated[
        float | None,
        Option(
            "nm per pixel at this height above the plane of the calibration, away from the pole piece.",
            kind="height",
        ),
    ] = None


@click.command("at")
@click.argument("calibration", type=PATH)
@click.argument("magnification", type=float)
@options_of(AtOptions)
@json_option
def command(
    calibration: Path,
    magnification: float,
    options: AtOptions,
    as_json: bool,
) -> None:
    """Camera of CALIBRATION at MAGNIFICATION: K, P, distortion, nm per pixel, with uncertainty.

    \b
    Example:
      semcal at cal.yaml 5250 --json
      semcal at cal.yaml 5250 --budget --length 10um
    """
    model = Calibration.load(calibration)
    length_m, height_m = options.length_m, options.height_m or 0.0
    if not options.budget and length_m is not None:
        raise InvalidValueError("--length without --budget", expected="both, or neither")
    if options.budget or height_m:
        found = (
            budget_of_pixel_size(model, magnification, height_m=height_m)
            if length_m is None
            else budget_of_length(
                model,
                magnification,
                length_m,
                edge_sigma_px=options.edge_sigma_px,
                height_m=height_m,
            )
        )
        _echo_budget(found, of_length=length_m is not None, as_json=as_json)
        if model.scale_sigma.grid == 0.0:
            echo_notes(
                [
                    "the squares of the grid count as exact: the calibration was not told their certificate "
                    "(--squares-sigma of calibrate)"
                ]
            )
        return
    described = describe_camera(model, magnification)
    if as_json:
        echo_json(described)
    else:
        _echo_camera(described, model.at(magnification))
        origin = model.provenance
        click.echo(f"calibrated   {origin.describe_origin()}")
        click.echo(
            f"conditions   microscope {origin.describe_microscope()}; {origin.describe_conditions()}"
            if origin.conditions
            else f"conditions   {NOT_RECORDED}"
        )


def _echo_budget(budget: UncertaintyBudget, *, of_length: bool, as_json: bool) -> None:
    if as_json:
        parts = [
            {"source": p.source, "relative": p.relative, "share": budget.share(p)}
            for p in budget.parts
        ]
        echo_json(
            {
                "value_m": budget.value_m,
                "sigma_m": budget.sigma_m,
                "expanded_m": budget.expanded_m,
                "coverage": budget.coverage,
                "parts": parts,
            }
        )
        return
    echo_table(
        ["source of uncertainty", "%", "nm", "share %"],
        [
            [
                part.source,
                f"{100.0 * part.relative:.4f}",
                f"{1e9 * budget.value_m * part.relative:.4g}",
                f"{100.0 * budget.share(part):.1f}",
            ]
            for part in budget.parts
        ],
    )
    value, sigma, expanded = (1e9 * v for v in (budget.value_m, budget.sigma_m, budget.expanded_m))
    digits = min(max(1 - math.floor(math.log10(expanded)), 0), 6)
    what = "length" if of_length else "nm per px"
    unit = " nm" if of_length else ""
    click.echo(
        f"{what} {value:.{digits}f}{unit}, standard uncertainty {sigma:.{digits}f}, "
        f"expanded {expanded:.{digits}f} (k = {budget.coverage:g}): {200.0 * budget.relative:.3f} %"
    )


def _format_matrix(name: str, values: Any) -> str:
    rows = [" ".join(f"{v:14.6g}" for v in row) for row in values]
    return "\n".join(f"{name if i == 0 else '':9}[{row}]" for i, row in enumerate(rows))


def _echo_terms(described: dict[str, Any], camera: ScanCamera) -> None:
    """Print a line for each further term of the lens, and each other kind of distortion."""
    if not has_terms(camera):
        return
    value, sigma, sizes = (described[k] for k in ("parameters", "parameter_sigma", "terms_px"))
    kinds = {"xi_r4": "radial", **dict.fromkeys(("xi_u", "xi_v", "xi_w"), "decentring")}
    for name, kind in kinds.items():
        if value[name]:
            click.echo(
                f"{name:13}{value[name]:.6g} +- {sigma[name]:.2g} "
                f"(all {kind} {sizes[kind]:.2f} px at most)"
            )
    if value["xi_s"]:
        click.echo(
            f"spiral       {value['xi_s']:.6g} +- {sigma['xi_s']:.2g} "
            f"({sizes['spiral']:.2f} px at most)"
        )
    if sizes["coils"]:
        x, y = measure_along_axes(camera, "coils")
        click.echo(f"coils        {x:.2f} px at most along x, {y:.2f} px along y")
    if sizes["settling"]:
        click.echo(f"settling     {sizes['settling']:.2f} px at most along x")
    if sizes["residual field"]:
        click.echo(f"field        {sizes['residual field']:.2f} px at most, of the residual field")


def _echo_camera(camera: dict[str, Any], model: ScanCamera) -> None:
    value, sigma = camera["parameters"], camera["parameter_sigma"]
    (x, y), (sx, sy) = camera["pixel_size_m"], camera["pixel_size_sigma_m"]
    click.echo(
        f"magnification {camera['magnification']:g}, "
        f"image {camera['image_width_px']} x {camera['image_height_px']} px"
    )
    click.echo(f"nm per px      {1e9 * camera['mean_pixel_size_m']:.4f} (mean of both axes)")
    click.echo(f"  x            {x * 1e9:.4f} +- {sx * 1e9:.4f}")
    click.echo(f"  y            {y * 1e9:.4f} +- {sy * 1e9:.4f}")
    if camera["K"] is not None:
        click.echo(_format_matrix("K", camera["K"]))
        click.echo(_format_matrix("P", camera["P"]))
    else:
        click.echo("K, P         parallel projection: no finite focal length")
    click.echo(_format_matrix("P_affine", camera["P_affine"]))
    square = camera["rectified"]
    focal = "" if square["K"] is None else f"f {square['K'][0][0]:.6g} px, "
    click.echo(
        f"image_rect   {1e9 * square['pixel_size_m']:.4f} nm per px along both axes, {focal}"
        "principal point ({:.2f}, {:.2f}) px".format(*square["principal_point_px"])
    )
    click.echo(f"xi_r         {value['xi_r']:.6g} +- {sigma['xi_r']:.2g}")
    click.echo(f"xi_t         {value['xi_t']:.6g} +- {sigma['xi_t']:.2g}")
    _echo_terms(camera, model)
    click.echo(
        f"centre px    ({value['ex']:.2f} +- {sigma['ex']:.2f}, "
        f"{value['ey']:.2f} +- {sigma['ey']:.2f})"
    )
    click.echo(f"1/pivot      {value['rho']:.4g} +- {sigma['rho']:.2g} 1/m")
    if not camera["in_range"]:
        low, high = camera["magnification_range"]
        click.echo(
            f"warning: outside the calibrated range {low:g} to {high:g}: extrapolated", err=True
        )
