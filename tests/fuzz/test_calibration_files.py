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

"""Calibration files: whatever the text, a calibration that works and survives a round trip, or one clear line."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from semcal_ros import Calibration
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_camera import ScanCamera
from tests.helpers.fuzz_inputs import (
    YAML_PIECES,
    alias_bombs,
    changed,
    damaged,
    edited_text,
    edited_tree,
)
from tests.helpers.fuzz_support import attempt, fuzz, run_semcal

_RANGE = (500.0, 4000.0)
_VALUES = [1.02, 1.01, 0.002, 249.0, 262.0, 50.0, 0.002, 0.001, 227.0, 267.0]


def _functions() -> dict[str, ContinuousFunction]:
    """One of each kind, and constants."""
    made = {
        name: ContinuousFunction("chebyshev_log", np.array([value]), _RANGE)
        for name, value in zip(FUNCTION_NAMES, _VALUES, strict=True)
    }
    made["aspect"] = ContinuousFunction(
        "legendre", np.array([1.01, 1e-4, 2e-4]), _RANGE, breaks=np.array([1500.0])
    )
    made["px"] = ContinuousFunction("chebyshev", np.array([249.0, 1.0]), _RANGE)
    made["xi_r"] = ContinuousFunction("chebyshev_log", np.array([0.002, 1e-4]), _RANGE)
    made["ex"] = ContinuousFunction(
        "linear_log", np.array([227.0, 229.0, 230.0]), _RANGE, np.array([500.0, 1000.0, 4000.0])
    )
    made["ey"] = ContinuousFunction("ode", np.array([267.0, 1.0]), _RANGE, np.array([0.1, 0.2]))
    return made


def _calibration(residual: ResidualField | None = None) -> Calibration:
    functions = _functions()
    size = sum(function.size for function in functions.values())
    size += 0 if residual is None else residual.size
    spread = np.diag(np.arange(size) * 1e-6) + 1e-7
    return Calibration(
        functions=functions,
        covariance=spread @ spread.T,
        image_width=512,
        image_height=480,
        display_width_m=0.12,
        magnifications=(500.0, 1000.0, 4000.0),
        method="joint",
        statistics={"views": 12, "rms_px": 0.0625, "notes": ["a", {"b": None}]},
        residual=residual,
    )


@lru_cache(maxsize=1)
def _texts() -> tuple[str, ...]:
    knots = np.concatenate([np.full(3, -1.04), [-1.04, 1.04], np.full(3, 1.04)])
    coefficients = np.random.default_rng(6).normal(size=(1, 4, 4, 2)) * 1e-4
    return (
        _calibration().dumps(),
        _calibration(ResidualField(knots, knots, _RANGE, coefficients)).dumps(),
    )


@lru_cache(maxsize=1)
def _plain_trees() -> tuple[str, ...]:
    return tuple(json.dumps(yaml.safe_load(text)) for text in _texts())


def _check(calibration: Calibration) -> None:
    """What every calibration promises that was read from a file."""
    low, high = calibration.magnification_range
    assert 0.0 < low <= high < np.inf
    assert isinstance(calibration.image_width, int)
    for g in {low, float(np.sqrt(low * high)), high}:
        camera = calibration.at(g)
        assert isinstance(camera, ScanCamera)
        assert camera.in_range
        assert np.all(np.isfinite(camera.P_affine))
        assert camera.rho <= 0.0 or np.all(np.isfinite(camera.P))
        assert min(camera.pixel_size_m) > 0.0
        assert camera.covariance is not None
        assert np.all(np.isfinite(camera.covariance))
    text = calibration.dumps()
    again = Calibration.loads(text)
    assert again.dumps() == text
    np.testing.assert_array_equal(again.at(low).parameters, calibration.at(low).parameters)


def _loaded(text: str) -> Calibration:
    calibration = Calibration.loads(text)
    _check(calibration)
    return calibration


def test_the_valid_files_are_accepted() -> None:
    for text in _texts():
        assert attempt(lambda text=text: _loaded(text)) is not None


_PLAIN = _texts()[0]


@fuzz()
@given(text=edited_text(_texts(), YAML_PIECES))
@example(text=changed(_PLAIN, "version: 3\n", f"version: {'9' * 3000}\n"))
@example(text=changed(_PLAIN, "version: 3\n", f"version: '{'9' * 5000}'\n"))
@example(text=changed(_PLAIN, "display_width_m: 0.12", "display_width_m: .inf"))
@example(text=changed(_PLAIN, "display_width_m: 0.12", "display_width_m: 1" + "0" * 400))
@example(text=changed(_PLAIN, "image_width_px: 512", "image_width_px: 512.0"))
@example(text=changed(_PLAIN, "  size: 17", "  size: 17.0"))
@example(text=changed(_PLAIN, "  scale:", "  1: 2\n  scale:"))
@example(text=changed(_PLAIN, "[50.0]", "[1.0e-307]"))
@example(text=changed(_PLAIN, "[0.1, 0.2]", "[.nan, 0.2]"))
@example(text=changed(_PLAIN, "magnifications: [500.0,", "magnifications: [.nan,"))
@example(text="a: !!timestamp x")
@example(text='a: !!int ""')
@example(text="a: !!bool maybe")
@example(text="format: semcal-calibration\nversion: 0x" + "f" * 5000)
@example(text="[" * 200_000)
@example(text="- " * 200_000)
def test_edited_text(text: str) -> None:
    attempt(lambda: _loaded(text))


@fuzz(0.7)
@given(tree=edited_tree(_plain_trees()))
def test_edited_values(tree: Any) -> None:
    text = yaml.dump(tree, allow_unicode=False, sort_keys=False)
    attempt(lambda: _loaded(text))


@fuzz(0.5)
@given(
    text=alias_bombs("format: semcal-calibration\nversion: 1\nstatistics: {a: {}}\nmethod: {}\n")
)
def test_texts_that_stand_for_much_more(text: str) -> None:
    assert attempt(lambda: _loaded(text)) is None


@fuzz()
@given(data=damaged([text.encode() for text in _texts()]))
def test_damaged_files(folder: Path, data: bytes) -> None:
    path = folder / "calibration.yaml"
    path.write_bytes(data)

    def load() -> Calibration:
        calibration = Calibration.load(path)
        _check(calibration)
        return calibration

    attempt(load)


@fuzz(0.2)
@given(
    tree=edited_tree(_plain_trees()), g=st.sampled_from(["500", "2000", "1e9", "nan", "-1", "x"])
)
def test_the_command_line(
    folder: Path, capfd: pytest.CaptureFixture[str], tree: Any, g: str
) -> None:
    path = folder / "calibration.yaml"
    path.write_text(yaml.dump(tree), encoding="utf-8", errors="surrogatepass")
    attempt(lambda: run_semcal(capfd, "at", path, g, "--json"))
