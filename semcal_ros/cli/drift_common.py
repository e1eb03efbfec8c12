"""What the commands that follow the drift of a recording share."""

from __future__ import annotations

from collections import Counter

import click
import numpy as np

from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftEstimate, DriftPath

__all__ = [
    "echo_nominal_unit",
    "echo_states",
    "forecast_text",
    "frame_time_option",
    "live_option",
    "rate_text",
]


frame_time_option = click.option(
    "--frame-time",
    type=click.FloatRange(0.0, min_open=True),
    metavar="S",
    help="Seconds of one pass over a frame, instead of what the configuration says.",
)
live_option = click.option(
    "--live", is_flag=True, help="What was known live, without hindsight of later frames."
)


def echo_states(states: Counter[str]) -> None:
    """Print how many frames had which kind of drift."""
    for kind, count in states.most_common():
        click.echo(f"{count} frames {kind}")


def echo_nominal_unit(config: MicroscopeConfig, what: str) -> None:
    """Tell that lengths rest on the display width only."""
    click.echo(
        f"note: without --calibration {what} of the display width {config.display_width_m:g} m",
        err=True,
    )


def rate_text(path: DriftPath) -> str:
    """The drift rate at the last frame with its 1-sigma in nm/s; empty for a single frame."""
    if len(path) < 2:
        return ""
    parts = _lengths(path.velocity_m_s[-1], path.velocity_sigma_m_s[-1])
    return f"final drift rate: x {parts[0]}, y {parts[1]} nm/s"


def forecast_text(forecast: DriftEstimate, after_s: float) -> str:
    """A forecast with its 1-sigma in nm."""
    parts = _lengths(forecast.drift_m, np.sqrt(np.diag(forecast.covariance)[:2]))
    return f"drift {after_s:g} s after the last frame: x {parts[0]}, y {parts[1]} nm"


def _lengths(values: Array, sigmas: Array) -> list[str]:
    """Lengths in nm with their 1-sigma, to two digits of the smaller uncertainty."""
    known = 1e9 * float(np.min(sigmas))
    digits = int(np.clip(1 - np.floor(np.log10(known)), 0, 9)) if known > 0.0 else 3
    pairs = zip(1e9 * values, 1e9 * sigmas, strict=True)
    return [f"{v:.{digits}f} +- {s:.{digits}f}" for v, s in pairs]
