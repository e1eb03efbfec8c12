"""``semcal evaluate``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import (
    config_option,
    configured,
    echo_json,
    echo_table,
    magnification_option,
    progress,
)
from semcal_ros.core.calibration.evaluate import fit_poses, rms_by_magnification
from semcal_ros.files.recordings import open_recording
from semcal_ros.workflows.find_grid import collect_views, find_views, named_frames

__all__ = ["command"]

# That of a stage, where the calibration does not say.
_HEIGHT_SIGMA_M = 1e-4


@click.command("evaluate")
@click.argument("calibration", type=click.Path(path_type=Path))
@click.argument("recording", type=click.Path(path_type=Path))
@config_option
@magnification_option
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output.")
def command(
    calibration: Path, recording: Path, config: str, magnification: float | None, as_json: bool
) -> None:
    """Reprojection RMS of CALIBRATION on a grid RECORDING that it was not made from.

    Poses are fitted to each view; the camera is not.

    \b
    Example:
      semcal evaluate cal.yaml recordings/other_grid
    """
    model = Calibration.load(calibration)
    microscope = configured(config, model)
    with (
        open_recording(recording, microscope, magnification=magnification) as opened,
        progress(opened.frame_count, "finding corners") as bar,
    ):
        found, rejected = find_views(named_frames(opened), on_progress=bar.update)
    collected = collect_views(
        found,
        rejected,
        display_width_m=microscope.display_width_m,
        squares_m=microscope.squares_m,
    )
    fit = fit_poses(
        collected.views,
        lambda g: model.at(g).resized(*collected.image_size),
        height_sigma_m=_height_sigma_m(model.statistics),
    )
    by_magnification = rms_by_magnification(fit)
    low, high = model.magnification_range
    if as_json:
        echo_json(
            {
                "rms_px": fit.rms_px(),
                "views": len(collected.views),
                "rejected": len(collected.rejected),
                "by_magnification": [
                    {"magnification": g, "rms_px": rms, "in_range": low <= g <= high}
                    for g, rms in by_magnification.items()
                ],
            }
        )
        return
    echo_table(
        ["magnification", "views", "RMS px", ""],
        [
            [
                f"{g:g}",
                str(int((fit.magnifications == g).sum())),
                f"{rms:.4f}",
                "" if low <= g <= high else "out of range",
            ]
            for g, rms in by_magnification.items()
        ],
    )
    click.echo(
        f"{len(collected.views)} of {len(collected.views) + len(collected.rejected)} views, "
        f"RMS {fit.rms_px():.4f} px"
    )


def _height_sigma_m(statistics: Mapping[str, Any]) -> float:
    """The prior of the heights in the calibration; its statistics are for reading, and may have been edited."""
    priors = statistics.get("priors")
    height = priors.get("height_sigma_m") if isinstance(priors, Mapping) else None
    if isinstance(height, (int, float)) and 0.0 < height < math.inf:
        return float(height)
    return _HEIGHT_SIGMA_M
