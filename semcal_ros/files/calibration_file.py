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

"""The calibration file: its text, and the checks when it is read."""

from __future__ import annotations

import base64
import binascii
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import yaml

from semcal_ros.bridge.calibration import MAX_TEXT_BYTES
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma, names_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.records import (
    Certificate,
    FitRecord,
    LadderRecord,
    Provenance,
    Relay,
    ScaleShares,
)
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.errors import CalibrationFileError, InvalidValueError
from semcal_ros.files.atomic import atomic_write_text
from semcal_ros.files.plain_yaml import load_plain_yaml
from semcal_ros.text_files import read_text_file

# What is written. Version 1 has no provenance; a file with a number that is not listed is refused.
FILE_VERSION = 3
_READ_VERSIONS = (1, 2, FILE_VERSION)
_FORMAT = "semcal-calibration"
# Characters of a reason: it may repeat a value from the file, which can have any length.
_MAX_REASON = 400
_HEADER = (
    "# Calibration of a scanning electron microscope as functions of the magnification. SI units.\n"
)

# What the rounding of a file's numbers may leave below zero, per coefficient.
_NEGATIVE_CORRELATION = 1e-7
# libyaml if PyYAML was built with it: 20 times faster on the covariance.
_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def read_calibration(path: str | os.PathLike[str]) -> CalibrationModel:
    """Read a calibration file.

    Raises
    ------
    CalibrationFileError
        If the file is missing, unreadable, corrupt, of another kind, or of a newer version.
    """
    name = os.fspath(path)
    return parse_calibration(read_calibration_text(Path(name)), source=name)


def parse_calibration(text: str, *, source: str = "calibration") -> CalibrationModel:
    """Parse the text of a calibration file; ``source`` names it in errors.

    Raises
    ------
    CalibrationFileError
        As :func:`read_calibration`.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise CalibrationFileError(
            f"{source}: a text of {len(text)} characters",
            expected=f"a calibration of at most {MAX_TEXT_BYTES}",
        )
    data = load_plain_yaml(text, source)
    try:
        _check_kind(data, source)
        _check_schema(data, source)
        _check_whole_numbers(data)
        model = CalibrationModel(**_read_fields(data))
        _check_range(model)
        _check_cameras(model)
    except (ValueError, ArithmeticError) as error:
        # YAML allows integers of any length, and floats whose products overflow.
        known = isinstance(error, InvalidValueError)
        reason = str(error)[:_MAX_REASON] if known else "numbers that cannot be used"
        raise CalibrationFileError(
            f"{source}: {reason}", do="restore the file or calibrate again"
        ) from error
    return model


def format_calibration(model: CalibrationModel) -> str:
    """Format the text of the calibration file, with every number in full precision."""
    field = model.residual
    size = len(model.covariance) - (0 if field is None else field.size)
    of_functions = model.covariance[:size, :size]
    data: dict[str, Any] = {
        "format": _FORMAT,
        "version": FILE_VERSION,
        "method": model.method,
        "image_width_px": int(model.image_width),
        "image_height_px": int(model.image_height),
        "display_width_m": float(model.display_width_m),
        "magnifications": [float(g) for g in model.magnifications],
        "functions": {
            name: _write_function(model.functions[name]) for name in names_of(model.functions)
        },
        "statistics": _to_plain(model.statistics),
        **({} if model.record is None else {"fit_record": _write_record(model.record)}),
        "covariance": {
            "size": size,
            "upper_rows": [row[i:].tolist() for i, row in enumerate(of_functions)],
        },
    }
    if model.scale_sigma != ScaleSigma():
        data["scale_sigma"] = asdict(model.scale_sigma)
    if model.provenance != Provenance():
        known = asdict(model.provenance).items()
        data["provenance"] = {name: _to_plain(value) for name, value in known if value}
    if model.ladder is not None:
        data["ladder"] = _to_plain(asdict(model.ladder))
    if field is not None:
        data["residual_field"] = _write_field(field, model.covariance[size:])
    body: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=120, default_flow_style=None)
    return _HEADER + body


def write_calibration(model: CalibrationModel, path: str | os.PathLike[str]) -> None:
    """Write the calibration file completely or not at all.

    Raises
    ------
    CalibrationFileError
        If it cannot be written; an existing file is then untouched.
    """
    try:
        atomic_write_text(Path(path), format_calibration(model))
    except OSError as error:
        raise CalibrationFileError(
            f"{os.fspath(path)}: {error.strerror or error}",
            expected="a folder that can be written",
            do="choose another output",
        ) from error


def read_calibration_text(path: Path) -> str:
    """Read the text of a calibration file.

    Raises
    ------
    CalibrationFileError
        The file is missing, unreadable, not a regular file, too large, or not UTF-8 text.
    """
    return read_text_file(
        path,
        MAX_TEXT_BYTES,
        error=CalibrationFileError,
        expected="a readable calibration file",
        do="check the path, or make one with `semcal calibrate`",
    )


def _check_kind(data: Any, source: str) -> None:
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise CalibrationFileError(
            f"{source}: not a calibration file",
            expected=f"`format: {_FORMAT}`",
            do="make one with `semcal calibrate`",
        )
    version = data.get("version")
    if version not in _READ_VERSIONS or isinstance(version, bool):  # True equals 1
        newer = isinstance(version, int) and version > FILE_VERSION
        raise CalibrationFileError(
            f"{source}: file version {repr(version)[:40]}",
            expected=f"version 1 to {FILE_VERSION}",
            do="update semcal_ros" if newer else "calibrate again",
        )


@lru_cache(maxsize=1)
def _make_validator() -> Any:
    schema = resources.files("semcal_ros.files").joinpath("calibration.schema.json")
    return jsonschema.Draft202012Validator(json.loads(schema.read_text(encoding="utf-8")))


def _check_schema(data: Mapping[str, Any], source: str) -> None:
    try:
        error = next(_make_validator().iter_errors(data), None)
    except TypeError as wrong:  # the validator compares names with patterns
        raise CalibrationFileError(
            f"{source}: a key that is not text", expected="text as keys"
        ) from wrong
    if error is not None:
        where = ".".join(str(p) for p in error.absolute_path) or "top level"
        raise CalibrationFileError(
            f"{source}: at {where}, {error.message[:160]}",
            expected=f"a calibration file of version 1 to {FILE_VERSION}",
            do="restore the file or calibrate again",
        )


def _read_fields(data: Mapping[str, Any]) -> dict[str, Any]:
    covariance, field = _read_covariance(data["covariance"]), None
    if "residual_field" in data:
        field = _read_field(data["residual_field"])
        covariance = _add_field_covariance(
            covariance, data["residual_field"]["covariance"], field.size
        )
    width, *magnifications = _check_finite([data["display_width_m"], *data["magnifications"]])
    return {
        "functions": {
            name: _read_function(data["functions"][name]) for name in names_of(data["functions"])
        },
        "covariance": covariance,
        # The schema counts 512.0 as an integer.
        "image_width": int(data["image_width_px"]),
        "image_height": int(data["image_height_px"]),
        "display_width_m": width,
        "magnifications": tuple(magnifications),
        "method": data["method"],
        "statistics": data.get("statistics", {}),
        "residual": field,
        "scale_sigma": ScaleSigma(**data.get("scale_sigma", {})),
        "record": _read_record(data),
        "provenance": _read_provenance(data.get("provenance", {})),
        "ladder": _read_ladder(data.get("ladder")),
    }


def _read_ladder(data: Mapping[str, Any] | None) -> LadderRecord | None:
    if data is None:
        return None
    low, high = _check_finite(data["anchored"])
    relays = tuple(Relay(**relay) for relay in data.get("relays", ()))
    return LadderRecord((low, high), float(data["growth"]), relays)


def _write_record(record: FitRecord) -> dict[str, Any]:
    known = {name: value for name, value in asdict(record).items() if value is not None}
    return {name: _to_plain(value) for name, value in known.items()}


def _read_record(data: Mapping[str, Any]) -> FitRecord | None:
    if "fit_record" not in data:
        return _record_of_notes(data.get("statistics", {}), tuple(data["magnifications"]))
    values = dict(data["fit_record"])
    values["squares_m"] = tuple(values.get("squares_m", ()))
    if shares := values.get("scale_shares"):
        values["scale_shares"] = ScaleShares(
            **{name: tuple(parts) for name, parts in shares.items()}
        )
    if certificate := values.get("certificate"):
        held = tuple(certificate.get("held", ()))
        values["certificate"] = Certificate(**{**certificate, "held": held})
    return FitRecord(**values)


def _record_of_notes(
    notes: Mapping[str, Any], magnifications: tuple[float, ...]
) -> FitRecord | None:
    """Return the record of a file of version 1 or 2, which kept it among its notes; None where they do not say it."""
    try:
        fit, priors = notes["fit"], notes["priors"]
        visits = fit.get("visit_height_sigma_m")
        shares = fit.get("scale_shares")
        return FitRecord(
            float(priors["height_sigma_m"]),
            None if visits is None else float(visits),
            tuple(float(side) for side in notes.get("squares_m", ())),
            bool(priors.get("is_wide", False)),
            scale_shares=ScaleShares(
                magnifications, tuple(shares["corners"]), tuple(shares["visits"])
            )
            if shares
            else None,
        )
    except (KeyError, TypeError, ValueError, AttributeError, InvalidValueError):
        # Notes may have been edited.
        return None


def _read_provenance(data: Mapping[str, Any]) -> Provenance:
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in data.items()
    }
    conditions = data.get("conditions", {})
    for value in conditions.values():
        if not isinstance(value[0], str):
            _check_finite(value)
    values["conditions"] = {name: tuple(value) for name, value in conditions.items()}
    return Provenance(**values)


def _check_finite(values: Sequence[Any]) -> list[float]:
    numbers = [float(value) for value in values]
    if not np.all(np.isfinite(numbers)):
        raise InvalidValueError("numbers that are not finite", expected="finite numbers")
    return numbers


def _check_whole_numbers(data: Any) -> None:
    """Refuse those that are of no use and that numpy takes for objects."""
    if isinstance(data, Mapping):
        data = list(data.values())
    if isinstance(data, list):
        for part in data:
            _check_whole_numbers(part)
    elif isinstance(data, int) and abs(data) >= 2**63:
        raise InvalidValueError(f"a whole number of {len(str(abs(data)))} digits")


def _check_range(model: CalibrationModel) -> None:
    """Refuse magnifications at which the functions were never fitted, which would pass for calibrated ones."""
    if model.ladder is not None:
        # It has extended both.
        return
    low, high = model.magnification_range
    for name, function in model.functions.items():
        first, last = function.g_range
        if low < first * (1.0 - 1e-9) or high > last * (1.0 + 1e-9):
            raise InvalidValueError(
                f"magnifications of {low:g} to {high:g}, and {name} of {first:g} to {last:g}",
                expected="functions of all magnifications",
            )


def _check_cameras(model: CalibrationModel) -> None:
    """Refuse numbers that are valid one by one but overflow when a camera is evaluated."""
    right, bottom = model.image_width - 1.0, model.image_height - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        for g in model.magnifications:
            camera = model.at(g)
            camera.project_sigma(camera.sem_from_ideal(corners))
            if camera.rho > 0.0:
                camera.resized(1, 1).P  # noqa: B018


def _read_function(data: Mapping[str, Any]) -> ContinuousFunction:
    low, high = data["magnification_range"]
    return ContinuousFunction(
        data["kind"],
        np.array(data["coefficients"], dtype=np.float64),
        (float(low), float(high)),
        np.array(_check_finite(data.get("shape", []))),
        np.array(data.get("breaks", []), dtype=np.float64),
        np.array(_check_finite(data.get("extension", []))),
    )


def _write_function(function: ContinuousFunction) -> dict[str, Any]:
    out: dict[str, Any] = {
        "kind": function.kind,
        "magnification_range": [float(g) for g in function.g_range],
        "coefficients": function.coefficients.tolist(),
    }
    if len(function.shape):
        out["shape"] = function.shape.tolist()
    if len(function.breaks):
        out["breaks"] = function.breaks.tolist()
    if len(function.extension):
        out["extension"] = function.extension.tolist()
    return out


def _read_field(data: Mapping[str, Any]) -> ResidualField:
    low, high = data["magnification_range"]
    rows = [np.array(part, dtype=np.float64) for part in data["coefficients"]]
    if any(row.shape != rows[0].shape for row in rows):
        raise InvalidValueError("a residual field of uneven parts", expected="parts of equal size")
    knots_x, knots_y = (np.array(data[k], dtype=np.float64) for k in ("knots_x", "knots_y"))
    return ResidualField(knots_x, knots_y, (float(low), float(high)), np.stack(rows))


def _write_field(field: ResidualField, covariance: Array) -> dict[str, Any]:
    """``covariance`` holds the rows of the field's coefficients, its last columns being their own."""
    count = len(covariance)
    cross, square = np.split(covariance, [covariance.shape[1] - count], axis=1)
    packed = np.concatenate([cross.ravel(), square[np.triu_indices(count)]])
    return {
        "magnification_range": [float(g) for g in field.g_range],
        "knots_x": field.knots_x.tolist(),
        "knots_y": field.knots_y.tolist(),
        "coefficients": field.coefficients.tolist(),
        # Hundreds of thousands of numbers: as text they would take seconds to read.
        "covariance": base64.b64encode(packed.astype("<f8").tobytes()).decode("ascii"),
    }


def _add_field_covariance(functions: Array, packed: str, count: int) -> Array:
    """The covariance of the functions' coefficients and of the field's, from its parts in the file."""
    size = len(functions)
    expected = count * size + count * (count + 1) // 2
    try:
        values = np.frombuffer(base64.b64decode(packed, validate=True), dtype="<f8")
    except (ValueError, binascii.Error) as error:
        raise InvalidValueError(
            "a covariance of the residual field that is not base64", expected="8 bytes per number"
        ) from error
    if len(values) != expected:
        raise InvalidValueError(
            f"a covariance of the residual field of {len(values)} numbers", expected=str(expected)
        )
    whole = np.zeros((size + count, size + count))
    whole[:size, :size] = functions
    whole[size:, :size] = values[: count * size].reshape(count, size)
    whole[:size, size:] = whole[size:, :size].T
    square = np.zeros((count, count))
    square[np.triu_indices(count)] = values[count * size :]
    whole[size:, size:] = square + np.triu(square, 1).T
    _check_covariance(whole)
    return whole


def _read_covariance(data: Mapping[str, Any]) -> Array:
    size, rows = int(data["size"]), data["upper_rows"]
    if [len(row) for row in rows] != list(range(size, 0, -1)):
        raise InvalidValueError(
            "a covariance of the wrong size", expected=f"{size} rows of the upper triangle"
        )
    upper = np.zeros((size, size))
    for i, row in enumerate(rows):
        upper[i, i:] = row
    matrix = upper + np.triu(upper, 1).T
    _check_covariance(matrix)
    return matrix


def _check_covariance(matrix: Array) -> None:
    if not np.all(np.isfinite(matrix)) or np.any(np.diag(matrix) < 0.0):
        raise InvalidValueError("an invalid covariance", expected="finite numbers, variances >= 0")
    # The coefficients have units that differ by orders of magnitude.
    unit = np.sqrt(np.diag(matrix))
    unit[unit == 0.0] = 1.0
    with np.errstate(over="ignore"):
        correlation = matrix / unit[:, None] / unit
    least, lowest = -np.inf, _NEGATIVE_CORRELATION * len(matrix)
    if np.all(np.abs(correlation) < 2.0):
        # With a residual field of a thousand coefficients the eigenvalues themselves would take seconds.
        with suppress(np.linalg.LinAlgError):
            np.linalg.cholesky(correlation + lowest * np.eye(len(matrix)))
            return
        least = float(np.linalg.eigvalsh(correlation)[0])
    if least < -lowest:
        raise InvalidValueError(
            f"a covariance whose correlations have the eigenvalue {least:.2g}",
            expected="no negative eigenvalue",
            do="calibrate again: the file was changed by hand, or damaged",
        )


def _to_plain(value: Any) -> Any:
    """Convert statistics to plain YAML types."""
    if isinstance(value, Mapping):
        return {str(k): _to_plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_plain(v) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value
