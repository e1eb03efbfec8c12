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

"""Renew a calibration with a few views of the grid.

The covariance of the calibration is the prior, and the changes that a check proves are free
(:mod:`~semcal_ros.core.calibration.judgement.check`). A distortion may have changed by the same amount at all
magnifications, or in proportion to what it was. What has not changed by that test may have aged a little: its
change has a prior of the ageing that the user states. The result is the posterior of a linear Gaussian model
(Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter 2), so that a second update with
other views continues from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.judgement.check import (
    CalibrationCheck,
    Verdict,
    check_calibration,
    gain_sigmas,
    groups_of_changes,
)
from semcal_ros.core.calibration.judgement.revision import (
    Revision,
    changing,
    free_sigmas,
    gaining,
    make_setup,
    revise,
)
from semcal_ros.core.calibration.judgement.thresholds import (
    AGEING_MAX,
    DEFAULT_AGEING,
    SHAPE_PART,
    UPDATE_MISFIT,
)
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel, columns_of, with_coefficients
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import CalibrationError, InvalidValueError

_UPDATE_WARNING = "scale: residuals of the update are"


@dataclass(frozen=True)
class CalibrationUpdate:
    """Result of :func:`update_calibration`.

    Attributes
    ----------
    model
        The renewed calibration.
    check
        What had changed.
    ageing
        1-sigma of the change of the scale that was allowed for without proof.
    rms_px
        RMS of the residuals of the new views.
    """

    model: CalibrationModel
    check: CalibrationCheck
    ageing: float
    rms_px: float


def update_calibration(
    model: CalibrationModel,
    views: Sequence[GridView],
    *,
    image_size: tuple[int, int],
    untilted: str | Sequence[str] = "auto",
    axis: StageAxis | None = None,
    ageing: float = DEFAULT_AGEING,
) -> CalibrationUpdate:
    """Renew a calibration by views of the grid, of which few are enough for what all magnifications share.

    Parameters
    ----------
    model
        The calibration.
    views
        New views in the calibrated range.
    image_size
        (width, height) of the images.
    untilted, axis
        As in :class:`~semcal_ros.core.calibration.options.CalibrationOptions`.
    ageing
        1-sigma of a relative change of the scale since the calibration; that of the other parameters is what
        displaces the edge of the image by a fifth of that. 0: what has not provably changed stays.

    Raises
    ------
    CalibrationError
        If no view lies in the calibrated range, or the views contradict the calibration: they are of another
        microscope, or show distortion that it cannot describe.
    InvalidValueError
        If the ageing is not from 0 to 0.1.
    """
    if not 0.0 <= ageing <= AGEING_MAX:
        raise InvalidValueError(f"an ageing of {ageing:g}", expected=f"0 to {AGEING_MAX:g}")
    check = check_calibration(model, views, image_size=image_size, untilted=untilted, axis=axis)
    if check.verdict is Verdict.INVALID:
        raise CalibrationError(
            f"views whose scale is {100.0 * check.scale_change:+.1f} % off that of the calibration",
            expected="the calibrated microscope, grid and display width",
            do="check --config, --squares and --display-width, else calibrate anew",
        )
    if check.not_renewable:
        raise CalibrationError(
            f"views that show a change of {' and of '.join(check.not_renewable)}",
            expected="at most a change of scale, aspect, skew, distortion, or centre of distortion",
            do="calibrate anew",
        )
    setup = make_setup(model, views, image_size, untilted, axis or StageAxis())
    free, groups = free_sigmas(model, setup), groups_of_changes(model)
    proven = {name for change in check.changes for name in groups[change.name]}
    aged = ageing_sigmas(model, ageing, image_size[0])
    sigmas = {name: free[name] if name in proven else own for name, own in aged.items()}
    revision = revise(model, setup, sigmas, gain_sigmas(model, setup, check.changes))
    rms_px = float(np.sqrt(np.mean(np.sum(revision.result.residuals_px**2, axis=1))))
    renewed = _apply(revision)
    log = model.statistics.get("updates", [])
    entry = {
        "views": check.views,
        "rms_px": rms_px,
        "ageing": ageing,
        "changed": [change.name for change in check.changes],
        "scale_change": check.scale_change,
        "scale_sigma": check.scale_sigma,
    }
    statistics = {**model.statistics, "updates": [*(log if isinstance(log, list) else []), entry]}
    statistics |= {"warnings": _warnings_after(model.statistics.get("warnings"), check.misfit)}
    record = model.record
    if record is not None:
        # What the covariance consists of is no longer what the calibration says.
        record = replace(record, scale_shares=None)
    renewed = replace(renewed, statistics=statistics, record=record)
    return CalibrationUpdate(renewed, check, ageing, rms_px)


def _warnings_after(before: object, misfit: float) -> list[str]:
    """The warnings of a calibration after an update, of which the last one alone is spoken."""
    kept = [text for text in before if isinstance(text, str)] if isinstance(before, list) else []
    kept = [text for text in kept if not text.startswith(_UPDATE_WARNING)]
    if misfit > UPDATE_MISFIT:
        kept.append(
            f"{_UPDATE_WARNING} {misfit:.1f} times what the uncertainty of the corners explains: the pictures are "
            "noisy or blurred, or the camera has changed in a way that few views do not tell; what was renewed is less "
            "certain than stated"
        )
    return kept


def ageing_sigmas(model: CalibrationModel, ageing: float, image_width: int) -> dict[str, float]:
    """Return the prior 1-sigma of each change of :func:`~semcal_ros.core.calibration.judgement.revision.changing`.

    Parameters
    ----------
    model
        The calibration.
    ageing
        That of the scale, relative.
    image_width
        Of the images in whose pixels a centre moves.
    """
    # The scale displaces the edge by ageing x half a width; so do xi_r, xi_t and xi_u there, at a distance of 1. The
    # centre of the distortion moves by that displacement itself.
    part = SHAPE_PART * ageing
    sigmas = dict.fromkeys(changing(model), part)
    sigmas |= dict.fromkeys(("ex", "ey"), part * 0.5 * image_width)
    return sigmas | {"scale": ageing}


def change_directions(model: CalibrationModel, image_width: int) -> Array:
    """Return the change (K, P) of a calibration's coefficients per unit of each of the things that may change.

    Parameters
    ----------
    model
        The calibration.
    image_width
        Of the images in whose pixels a centre moves.
    """
    columns = columns_of(model.functions)
    # Images of another size have their centre at another pixel, in other units.
    per_px = model.image_width / image_width
    names = changing(model)
    changes = np.zeros((len(model.coefficients), len(names)))
    for column, name in enumerate(names):
        own, function = columns[name], model.functions[name]
        if name == "scale":
            changes[own, column] = function.coefficients
        else:
            changes[own, column] = _constant(function) * (per_px if name in ("ex", "ey") else 1.0)
    return changes


def _constant(function: ContinuousFunction) -> Array:
    """Coefficients with which a function is 1 at all magnifications."""
    grid = np.union1d(np.geomspace(*function.g_range, 64), function.breaks)
    basis = np.stack([function.basis(float(g)) for g in grid])
    return np.asarray(np.linalg.lstsq(basis, np.ones(len(grid)), rcond=None)[0], dtype=np.float64)


def _apply(revision: Revision) -> CalibrationModel:
    """The posterior of the coefficients.

    The residual field was taken out of the views as it is, so that they say nothing of it: it keeps its values and its
    covariance, and loses of its correlation with the coefficients what these lose of their uncertainty.
    """
    model, theta = revision.model, revision.result.state.theta
    root = model.principal_components
    changes = change_directions(model, revision.setup.image_size[0])
    columns = columns_of(model.functions)
    names = gaining(model)
    gains = np.zeros((len(root), len(names)))
    for column, name in enumerate(names):
        gains[columns[name], column] = model.functions[name].coefficients
    steps, size = np.concatenate([root, changes, gains], axis=1), len(root)
    index = np.r_[revision.components, revision.changes, revision.gains]
    values = model.coefficients + steps @ theta[index]
    own = revision.covariance[np.ix_(index, index)]
    covariance = model.covariance.copy()
    covariance[:size, :size] = steps @ own @ steps.T
    if len(covariance) > size:
        cross = np.linalg.pinv(root) @ model.covariance[:size, size:]
        gain = own[:, :size]
        covariance[:size, size:] = steps @ gain @ cross
        covariance[size:, :size] = covariance[:size, size:].T
    covariance = 0.5 * (covariance + covariance.T)
    return replace(
        model, functions=with_coefficients(model.functions, values), covariance=covariance
    )
