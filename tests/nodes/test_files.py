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

"""Which files a node reads because somebody asked it to by a service."""

from __future__ import annotations

import os
from pathlib import Path

from rcl_interfaces.msg import ParameterType, ParameterValue

from semcal_ros.nodes.frames.calibration_input import calibration_digest
from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import Peer, ended, running

SERVER = "/sem/parameter_server"
CALIBRATION = make_calibration()


def _text(path: object) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(path))


def test_files_are_read_from_the_folder_of_the_one_given_at_start(
    peer: Peer, tmp_path: Path
) -> None:
    inside, outside = tmp_path / "inside", tmp_path / "outside"
    for folder in (inside, outside):
        folder.mkdir()
        CALIBRATION.save(folder / "cal.yaml")
    (inside / "good").symlink_to(inside / "cal.yaml")
    (inside / "bad").symlink_to(outside / "cal.yaml")
    os.mkfifo(inside / "pipe")
    with running("parameter_server", {"calibration": inside / "cal.yaml"}) as node:
        for path in (inside / "good", inside / ".." / "inside" / "cal.yaml", ""):
            result = peer.set_parameter(SERVER, "calibration", _text(path))
            assert result.successful, result.reason
        refusals = {
            outside / "cal.yaml": "inside",
            inside / ".." / "outside" / "cal.yaml": "inside",
            inside / "bad": f"which is {outside / 'cal.yaml'}",
            "/etc/passwd": "inside",
            # Nobody writes to it: who opened it would wait for ever.
            inside / "pipe": "not a file",
            inside: "Is a directory",
            inside / "missing": "No such file",
            inside / ("x" * 300): "File name too long",
        }
        for path, reason in refusals.items():
            result = peer.set_parameter(SERVER, "calibration", _text(path))
            assert not result.successful
            assert reason in result.reason
        # Fixed for as long as the node runs.
        assert not peer.set_parameter(SERVER, "directory", _text(outside)).successful
        # A dump that is loaded again names it too.
        assert peer.set_parameter(SERVER, "directory", _text("")).successful

        file = inside / "cal.yaml"
        assert peer.set_parameter(SERVER, "calibration", _text(file)).successful
        file.unlink()
        file.symlink_to(outside / "cal.yaml")
        answer = peer.trigger(f"{SERVER}/reload")
        assert not answer.success
        assert "inside" in answer.message
        file.unlink()
        file.write_bytes(CALIBRATION.dumps().encode()[:1000] + b"\xff\x00")
        answer = peer.trigger(f"{SERVER}/reload")
        assert not answer.success
        assert "not UTF-8 text" in answer.message
        (p,) = peer.get_parameters(SERVER, "p@1000")
        assert p.double_array_value.tolist() == CALIBRATION.at(1000.0).P.ravel().tolist()
        wanted = calibration_digest(CALIBRATION.dumps())
        peer.wait_for(
            lambda: peer.state(SERVER).get("calibration_digest") == wanted, "the digest of the file"
        )
        assert node.process.poll() is None


def test_without_a_folder_no_file_can_be_named(peer: Peer, tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "cal.yaml")
    with running("parameter_server"):
        result = peer.set_parameter(SERVER, "calibration", _text(tmp_path / "cal.yaml"))
    assert not result.successful
    assert "directory" in result.reason


def test_a_directory_that_is_none_ends_the_node_with_one_line(tmp_path: Path) -> None:
    status, output = ended("parameter_server", {"directory": tmp_path / "missing"})
    assert status == 2
    assert "which is not a folder" in output
    assert len(output.strip().splitlines()) == 1
