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

"""Continuous parameters: names and values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.bridge.continuous_parameters import (
    PARAMETER_KINDS,
    continuous_value,
    is_continuous_parameter,
    parse_parameter_name,
    read_parameter,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError


class OneCamera:
    """A calibration from 100 x to 10 000 x whose scale follows the magnification."""

    magnification_range = (100.0, 10000.0)

    def __init__(self, camera: ScanCamera) -> None:
        self._camera = camera

    def at(self, magnification: float, /) -> ScanCamera:
        scale = magnification / self._camera.magnification
        return replace(self._camera, magnification=magnification, m=self._camera.m * scale)


@given(kind=st.sampled_from(PARAMETER_KINDS), g=st.floats(1e-3, 1e9))
def test_names_round_trip(kind: str, g: float) -> None:
    assert parse_parameter_name(f"{kind}@{g!r}") == (kind, g)


@pytest.mark.parametrize(("number", "g"), [("5250", 5250.0), ("2345.6", 2345.6), ("1e4", 1e4)])
def test_ways_to_write_a_magnification(number: str, g: float) -> None:
    assert parse_parameter_name(f"p@{number}").magnification == g


@pytest.mark.parametrize(
    "name",
    [
        *("p", "@", "p@", "@500", "q@500", "P@500", "pp@500", "p@500@500"),
        *("p@0", "p@-5", "p@nan", "p@inf", "p@1e999", "p@0x10", "p@5,5", "p@1_000"),
        *("p@ 500", "p@500 ", "p@500\n", "p@\u0665"),
    ],
)
def test_malformed_names(name: str) -> None:
    with pytest.raises(InvalidValueError) as caught:
        parse_parameter_name(name)
    assert caught.value.expected
    assert "\n" not in str(caught.value)


@given(st.text(max_size=30))
def test_any_text_gives_a_request_or_a_reason(name: str) -> None:
    try:
        request = parse_parameter_name(name)
    except InvalidValueError:
        return
    assert request.kind in PARAMETER_KINDS
    assert request.magnification > 0


def test_ordinary_parameters_are_left_alone() -> None:
    assert is_continuous_parameter("p@5250")
    assert is_continuous_parameter("nonsense@")
    assert not is_continuous_parameter("use_sim_time")


def test_values(camera: ScanCamera) -> None:
    assert continuous_value("p", camera) == camera.P.reshape(-1).tolist()
    assert continuous_value("k", camera) == camera.K.reshape(-1).tolist()
    assert continuous_value("p_affine", camera)[8:] == [0.0, 0.0, 50.0, 1.0]
    assert continuous_value("d", camera) == [0.002, 0.001]
    assert continuous_value("e", camera) == [227.0, 267.0]
    # m = 2.1e7 px per m with aspect 1.01.
    assert continuous_value("pixel_size", camera) == pytest.approx(
        [1 / 2.121e7, 1.01 / 2.1e7], rel=1e-12
    )
    assert all(
        isinstance(v, float) for kind in PARAMETER_KINDS for v in continuous_value(kind, camera)
    )


def test_sigma_at_centre_and_corners(camera: ScanCamera) -> None:
    # Only px (3 px) and py (4 px) are uncertain; without distortion they shift all pixels by 5 px.
    plain = replace(camera, xi_r=0.0, xi_t=0.0)
    np.testing.assert_allclose(continuous_value("sigma", plain), np.full(5, 5.0), rtol=1e-9)
    assert len(set(np.round(continuous_value("sigma", camera), 6))) == 5


def test_what_a_camera_does_not_have(camera: ScanCamera) -> None:
    parallel = replace(camera, rho=0.0)
    for kind in ("p", "k"):
        with pytest.raises(InvalidValueError, match="P_affine"):
            continuous_value(kind, parallel)
    assert len(continuous_value("p_affine", parallel)) == 12
    with pytest.raises(InvalidValueError, match="covariance"):
        continuous_value("sigma", replace(camera, covariance=None))
    with pytest.raises(InvalidValueError, match="corner"):
        continuous_value("sigma", replace(camera, xi_r=0.2))
    with pytest.raises(InvalidValueError, match="kind"):
        continuous_value("z", camera)


def test_read_by_name(camera: ScanCamera) -> None:
    calibration = OneCamera(camera)
    assert read_parameter("pixel_size@2500", calibration) == pytest.approx(
        [2 / 2.121e7, 2.02 / 2.1e7], rel=1e-12
    )
    assert read_parameter("d@100", calibration) == [0.002, 0.001]
    for name in ("p@99.9", "p@10000.1"):
        with pytest.raises(InvalidValueError, match="100 to 10000"):
            read_parameter(name, calibration)
