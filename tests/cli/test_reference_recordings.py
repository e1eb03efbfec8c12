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

"""The commands on the reference recordings, which another simulator made."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from semcal_ros import Calibration
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.cli import main
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.files.bags.reader import open_bag
from tests.helpers.made_once import folder_once

pytestmark = [pytest.mark.slow, pytest.mark.long]


@pytest.fixture(scope="module")
def calibration(reference_data):
    def calibrate(folder):
        command = ["calibrate", str(reference_data / "grid_calibration")]
        assert main([*command, "-o", str(folder / "cal.yaml")]) == 0

    return folder_once("reference", calibrate) / "cal.yaml"


def _true_cameras(reference_data, recording):
    truth = json.loads((reference_data / recording / "truth.json").read_text())
    for key, p in truth["params"].items():
        yield ScanCamera(
            float(key), p["m"] * 1e6, p["a"], p["s"] / p["m"], p["px"], p["py"], p["rho"] * 1e6,
            p["xr"], p["xt"], p["ex"], p["ey"], 256.0, 512, 512,
        )  # fmt: skip


def test_all_views_are_used_and_the_scale_is_right(calibration, reference_data):
    cal = Calibration.load(calibration)
    assert cal.statistics["views"] >= 100
    assert all(row["held_out_rms_px"] is not None for row in cal.statistics["by_magnification"])
    for recording in ("grid_calibration", "grid_zoom_sweep"):
        for camera in _true_cameras(reference_data, recording):
            # Issue: 0.3 %. The heights of the views (40 um over a pivot of 20 mm) allow about 0.1 %.
            assert cal.at(camera.magnification).m == pytest.approx(camera.m, rel=3e-3)


def test_rectified_sweep_pairs_one_to_one(calibration, reference_data, tmp_path):
    out = tmp_path / "out"
    source = str(reference_data / "grid_zoom_sweep")
    assert main(["rectify", source, "--calibration", str(calibration), "-o", str(out)]) == 0
    stamps: dict[str, list[int]] = {"/sem/image_rect": [], "/sem/camera_info": []}
    with open_bag(out) as bag:
        for message in bag.messages(list(stamps)):
            stamps[message.topic].append(stamp_ns_from_msg(message.message))
    assert len(stamps["/sem/image_rect"]) == 36
    assert stamps["/sem/image_rect"] == stamps["/sem/camera_info"]


def test_drift_follows_the_truth(calibration, reference_data, tmp_path):
    table = tmp_path / "drift.csv"
    source = str(reference_data / "gold_drift_5000x")
    assert main(["drift", source, "--calibration", str(calibration), "-o", str(table)]) == 0
    truth = json.loads((reference_data / "gold_drift_5000x" / "truth.json").read_text())["frames"]
    with table.open() as file:
        found = np.array([[float(r["dx_m"]), float(r["dy_m"])] for r in csv.DictReader(file)])
    drift = np.array([f["drift_um"] for f in truth]) * 1e-6
    error_px = (found - (drift - drift[0])) / (truth[0]["um_per_px"] * 1e-6)
    # The aim for this recording is 0.03 px RMS over 5 px of drift.
    assert np.sqrt(np.mean(np.sum(error_px**2, axis=1))) < 0.03
