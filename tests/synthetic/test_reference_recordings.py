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

"""The virtual SEM against recordings of an independent simulator with the same parameters."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.synthetic import NOISE_FREE, ChessGrid, Pose, preset, render_frame

UM = 1e-6


@dataclass(frozen=True)
class Tabulated:
    """A law that only knows the magnifications of a table."""

    values: tuple[tuple[float, float], ...]

    def __call__(self, magnification: float) -> float:
        return dict(self.values)[magnification]


def test_frames_lie_where_an_independent_simulator_puts_them(reference_data: Path) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    folder = reference_data / "grid_calibration"
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))

    def law(value: Callable[[float, dict[str, Any]], float]) -> Tabulated:
        table = truth["params"].items()
        return Tabulated(tuple((float(g), value(float(g), p)) for g, p in table))

    microscope = replace(
        preset("jsm820"),
        scale_error=law(lambda g, p: p["m"] / UM * 0.12 / (512 * g) - 1.0),
        aspect=law(lambda g, p: p["a"]),
        skew=law(lambda g, p: p["s"] / p["m"]),
        px=law(lambda g, p: p["px"]),
        py=law(lambda g, p: p["py"]),
        rho=law(lambda g, p: p["rho"] / UM),
        xi_r=law(lambda g, p: p["xr"]),
        xi_t=law(lambda g, p: p["xt"]),
        ex=law(lambda g, p: p["ex"]),
        ey=law(lambda g, p: p["ey"]),
    )
    detector = replace(NOISE_FREE, blur_px=0.8)
    wanted = {3, 33, 64, 102}
    with rosbags.AnyReader([folder]) as reader:
        images = [c for c in reader.connections if c.topic == "/sem/image_raw"]
        for index, (connection, _, raw) in enumerate(reader.messages(images)):
            if index not in wanted:
                continue
            message = reader.deserialize(raw, connection.msgtype)
            theirs = message.data.reshape(512, -1)[:, :512].astype(np.float64)
            frame = truth["frames"][index]
            pose = Pose(np.array(frame["R"]), np.array(frame["t_um"]) * UM)
            board = ChessGrid(frame["square_um"] * UM)
            g = frame["magnification"]
            ours = render_frame(microscope, board, pose, g, detector=detector) / 65535.0
            # theirs(x) = gain * ours(x + shift) + offset, linearised; the noise allows 0.003 px.
            gradient_y, gradient_x = np.gradient(ours)
            columns = [gradient_x, gradient_y, ours, np.ones_like(ours)]
            matrix = np.stack([column.ravel() for column in columns], axis=1)
            fit = np.linalg.lstsq(matrix, theirs.ravel(), rcond=None)[0]
            assert fit[2] > 0  # the same squares are bright
            assert np.abs(fit[:2] / fit[2]).max() < 0.015
            residual = theirs.ravel() - matrix @ fit
            assert 1.0 - residual.var() / theirs.var() > 0.92  # what is left is noise
