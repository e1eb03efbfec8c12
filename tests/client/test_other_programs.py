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

"""Programs that know nothing of this package: C++, rosbags alone, and a detector of AprilTags."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.core.camera.calibrated_frame import CalibratedFrame
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from tests.helpers.node_scenes import make_calibration, texture
from tests.helpers.project import ROOT

PAGE = (ROOT / "doc" / "howto" / "write_a_node.md").read_text(encoding="utf-8")
SIZE = 512


def listing(part: str) -> str:
    blocks = re.findall(r"(?:^    .*\n|^\n+(?=    ))+", PAGE, re.MULTILINE)
    (found,) = [block for block in blocks if part in block]
    return re.sub(r"^    ", "", found, flags=re.MULTILINE).lstrip("\n")


def frame_at(magnification: float) -> CalibratedFrame:
    camera = make_calibration().at(magnification).resized(SIZE, SIZE).rectified
    zeros = np.zeros((2, 2))
    return CalibratedFrame(
        zeros, 0, magnification, camera.P_affine, np.zeros((12, 12)), np.zeros(2), zeros
    )


# -- C++ -----------------------------------------------------------------------------------------------

MAIN = """
#include <cstdlib>
#include <iostream>
#include "lengths.hpp"
int main(int, char ** argv)
{
  double P[12];
  for (int k = 0; k < 12; ++k) { P[k] = std::atof(argv[1 + k]); }
  sensor_msgs::msg::Image message;
  message.encoding = "64FC1";
  message.data.resize(sizeof(P));
  std::memcpy(message.data.data(), P, sizeof(P));
  std::cout.precision(17);
  try {
    const auto place = metres_from_pixel(message, std::atof(argv[13]), std::atof(argv[14]));
    std::cout << place[0] << " " << place[1] << std::endl;
  } catch (const std::domain_error & error) {
    std::cout << error.what() << std::endl;
  }
}
"""


def includes() -> list[str]:
    """Folders of headers: of the wheels, and of a ROS installation."""
    roots = [Path(sys.prefix) / "include", *Path("/opt/ros").glob("*/include")]
    return [f"-I{folder}" for root in roots if root.is_dir() for folder in sorted(root.iterdir())]


@pytest.mark.long
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_lengths_in_cpp_are_those_of_python(tmp_path: Path) -> None:
    (tmp_path / "lengths.hpp").write_text(listing("#pragma once"), encoding="utf-8")
    (tmp_path / "main.cpp").write_text(MAIN, encoding="utf-8")
    command = ["g++", "-std=c++17", "-Wall", "-Werror", *includes(), "main.cpp", "-o", "main"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=150)
    frame, pixel = frame_at(2000.0), (100.25, 400.5)
    numbers = [repr(float(x)) for x in (*frame.P.ravel(), *pixel)]
    done = subprocess.run(
        [tmp_path / "main", *numbers], check=True, capture_output=True, text=True, timeout=10
    )
    expected = frame.metres_from_pixels(pixel).values[0]
    # Both in double precision.
    assert [float(word) for word in done.stdout.split()] == pytest.approx(expected, rel=1e-12)
    without = subprocess.run(
        [tmp_path / "main", *["0.0"] * 14], check=True, capture_output=True, text=True, timeout=10
    )
    assert without.stdout.strip() == "this frame has no camera"


@pytest.mark.long
@pytest.mark.skipif(
    shutil.which("g++") is None or not list(Path("/opt/ros").glob("*/include/rclcpp")),
    reason="no C++ compiler, or no headers of rclcpp",
)
def test_the_node_in_cpp_compiles(tmp_path: Path) -> None:
    (tmp_path / "lengths.hpp").write_text(listing("#pragma once"), encoding="utf-8")
    (tmp_path / "node.cpp").write_text(listing("image_transport.hpp"), encoding="utf-8")
    command = ["g++", "-std=c++17", "-fsyntax-only", *includes(), "node.cpp"]
    done = subprocess.run(
        command, cwd=tmp_path, check=False, capture_output=True, text=True, timeout=170
    )
    assert (done.returncode, done.stderr) == (0, "")


# -- rosbags alone -------------------------------------------------------------------------------------


def test_outputs_are_opened_without_this_package(tmp_path: Path) -> None:
    magnifications = (1000.0, 2500.0)
    with BagWriter(tmp_path / "outputs") as writer:
        for k, g in enumerate(magnifications):
            stamp_ns = 1_700_000_000_000_000_000 + k * 10**8
            matrix, image = (blank_message("sensor_msgs/msg/Image") for _ in range(2))
            for message in (matrix, image):
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            matrix.height, matrix.width, matrix.step, matrix.encoding = 3, 4, 32, "64FC1"
            matrix.data = frame_at(g).P.reshape(-1).view(np.uint8)
            writer.write("/sem/projection_stamped", stamp_ns, matrix)
            image.height = image.width = image.step = 64
            image.encoding, image.data = "mono8", texture(k, 64).reshape(-1)
            writer.write("/sem/image_rect", stamp_ns + 1000, image)
    code = "import sys; sys.modules['semcal_ros'] = sys.modules['rclpy'] = None\n"
    (tmp_path / "outputs.py").write_text(code + listing("AnyReader"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, tmp_path / "outputs.py", tmp_path / "outputs"],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    )
    said = re.findall(r"\(64, 64\) ([\d.]+) nm per pixel", done.stdout)
    expected = [1e9 * frame_at(g).pixel_size_m for g in magnifications]
    assert [float(text) for text in said] == pytest.approx(expected, abs=1e-3)


# -- AprilTag ------------------------------------------------------------------------------------------

# Side of the black square, m.
TAG_M = 8e-6


def tag_picture(magnification: float, turn_rad: float) -> NDArray[np.uint8]:
    """The rectified picture of a tag of the family 36h11 that lies turned on the specimen."""
    kind = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    cells = 10
    tag = cv2.aruco.generateImageMarker(kind, 7, 8 * cells)
    # A white border of a cell, without which no detector finds it.
    drawn = np.pad(tag, cells, constant_values=255)
    corner_px = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * 8.0 * cells + cells - 0.5
    frame = frame_at(magnification)
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    middle_m = frame.metres_from_pixels((0.5 * SIZE, 0.5 * SIZE)).values[0]
    corner_m = middle_m + TAG_M * (np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) - 0.5) @ turn.T
    seen_px = frame.pixels_from_metres(corner_m).values
    warp = cv2.getPerspectiveTransform(corner_px.astype(np.float32), seen_px.astype(np.float32))
    # Drawn at four times the size and averaged, as a detector averages over a pixel.
    fine = np.diag([4.0, 4.0, 1.0]) @ np.array([[1, 0, 0.375], [0, 1, 0.375], [0, 0, 1]]) @ warp
    grey = cv2.warpPerspective(drawn, fine, (4 * SIZE, 4 * SIZE), borderValue=255)
    return cv2.resize(grey, (SIZE, SIZE), interpolation=cv2.INTER_AREA).astype(np.uint8)


@pytest.mark.parametrize(("magnification", "turn_rad"), [(1500.0, 0.2), (3000.0, 0.4)])
def test_a_tag_has_its_side_in_metres(magnification: float, turn_rad: float) -> None:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    kind = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = tag_picture(magnification, turn_rad)
    corners, names, _ = cv2.aruco.ArucoDetector(kind, settings).detectMarkers(image)
    assert [int(name) for name in np.ravel(names)] == [7]
    places = frame_at(magnification).metres_from_pixels(np.reshape(corners[0], (4, 2))).values
    sides = np.linalg.norm(np.roll(places, -1, axis=0) - places, axis=1)
    # It fits lines to the edges, to some hundredths of a pixel where these cross rows and columns.
    assert sides == pytest.approx(TAG_M, abs=0.1 * frame_at(magnification).pixel_size_m)
