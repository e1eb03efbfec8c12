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

"""Which prefixes the ament index is searched under."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from semcal_ros.core.errors import ConfigError
from semcal_ros.middleware import (
    DEFAULT_SEGMENT_BYTES,
    MALLOC_VARIABLES,
    PROFILE_VARIABLES,
    add_environment_prefix,
    profile_file,
    shared_memory,
    transport_advice,
)

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "dds" / "fastdds_large_images.xml"
MIB = 1024**2
FAST = "rmw_fastrtps_cpp"
MALLOC = dict.fromkeys(MALLOC_VARIABLES, str(256 * MIB))
CLEAN = {
    name: value
    for name, value in os.environ.items()
    if name not in {*PROFILE_VARIABLES, *MALLOC_VARIABLES, "FASTDDS_BUILTIN_TRANSPORTS"}
}
# The segment that a participant makes is a file in /dev/shm, which its process has mapped.
PROBE = """
import os, re, rclpy
rclpy.init()
node = rclpy.create_node("probe")
names = set(re.findall(r"/dev/shm/fast(?:rtps|dds)_[0-9a-f]{16}$", open("/proc/self/maps").read(), re.M))
print("segments", *(os.stat(name).st_size for name in names))
rclpy.shutdown()
"""


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    marker = tmp_path / "share" / "ament_index" / "resource_index" / "packages" / "semcal_ros"
    marker.parent.mkdir(parents=True)
    marker.touch()
    return tmp_path


def test_the_environment_comes_first_and_only_once(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    for _ in range(2):
        add_environment_prefix()
        assert os.environ["AMENT_PREFIX_PATH"] == f"{prefix}{os.pathsep}/opt/ros/jazzy"


def test_an_empty_variable_adds_no_empty_prefix(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    add_environment_prefix()
    assert os.environ["AMENT_PREFIX_PATH"] == str(prefix)


def test_an_environment_without_the_suite_is_not_added(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "prefix", str(prefix / "other"))
    add_environment_prefix()
    assert "AMENT_PREFIX_PATH" not in os.environ


def profile(transports: str = "", rtps: str = "") -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">'
        f"<transport_descriptors>{transports}</transport_descriptors>"
        f'<participant profile_name="p" is_default_profile="true"><rtps>{rtps}</rtps>'
        "</participant></profiles>"
    )


def shm(segment: int | None = None) -> str:
    size = "" if segment is None else f"<segment_size>{segment}</segment_size>"
    return (
        "<transport_descriptor><transport_id>s</transport_id><type>SHM</type>"
        f"{size}</transport_descriptor>"
        "<transport_descriptor><transport_id>u</transport_id><type>UDPv4</type></transport_descriptor>"
    )


def used(*names: str, builtin: str = "false") -> str:
    ids = "".join(f"<transport_id>{name}</transport_id>" for name in names)
    return (
        f"<userTransports>{ids}</userTransports>"
        f"<useBuiltinTransports>{builtin}</useBuiltinTransports>"
    )


def with_profile(path: Path, text: str) -> dict[str, str]:
    path.write_text(text, encoding="utf-8")
    return dict.fromkeys(PROFILE_VARIABLES, str(path))


def real_segments(environment: Mapping[str, str]) -> list[int]:
    """Sizes of the segments that a node with this environment makes, bytes."""
    done = subprocess.run(
        [sys.executable, "-c", PROBE],
        env=dict(environment),
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    (line,) = re.findall(r"^segments(.*)$", done.stdout, re.MULTILINE)
    return [int(size) for size in line.split()]


CASES = {
    "default": ("", DEFAULT_SEGMENT_BYTES),
    "own": (profile(shm(3 * MIB), used("s", "u")), 3 * MIB),
    "with the built-in ones": (profile(shm(3 * MIB), used("s", builtin="true")), 3 * MIB),
}


@pytest.mark.parametrize("reach", ["OFF", "LOCALHOST"])
@pytest.mark.parametrize("case", ["default", "own"])
def test_the_segment_is_the_one_that_fast_dds_makes(case: str, reach: str, tmp_path: Path) -> None:
    _check_segment(case, reach, tmp_path)


def test_of_two_segments_the_larger_counts(tmp_path: Path) -> None:
    _check_segment("with the built-in ones", "OFF", tmp_path)


def _check_segment(case: str, reach: str, folder: Path) -> None:
    text, expected = CASES[case]
    environment = {**CLEAN, "ROS_AUTOMATIC_DISCOVERY_RANGE": reach}
    if text:
        environment.update(with_profile(folder / "profile.xml", text))
    assert shared_memory(environment).segment_bytes == expected
    # Beside the messages the segment holds their descriptors: a twentieth with the default queue.
    assert expected <= max(real_segments(environment)) < 1.1 * expected


@pytest.mark.parametrize("text", [profile(shm(), used("s")), profile(shm(), used("u"))])
def test_a_profile_that_states_no_size_is_not_judged(text: str, tmp_path: Path) -> None:
    environment = {**MALLOC, **with_profile(tmp_path / "p.xml", text)}
    assert shared_memory(environment).segment_bytes is None
    assert transport_advice(64 * MIB, environment, FAST) == ""


def test_the_shipped_profile_carries_the_largest_frames() -> None:
    environment = dict.fromkeys(PROFILE_VARIABLES, str(SHIPPED))
    # Frames of 4096 x 4096 with 16 bits, and three of them waiting.
    assert shared_memory(environment).segment_bytes >= 4 * 32 * MIB
    assert transport_advice(32 * MIB, {**environment, **MALLOC}, FAST) == ""


def test_only_what_does_not_fit_is_advised(tmp_path: Path) -> None:
    environment = {**MALLOC, **with_profile(tmp_path / "p.xml", profile(shm(2 * MIB), used("s")))}
    assert transport_advice(2 * MIB, environment, FAST) == ""
    advice = transport_advice(2 * MIB + 1, environment, FAST)
    assert "2.0 MiB" in advice
    assert "p.xml" in advice
    assert "Large images" in advice
    small = with_profile(tmp_path / "small.xml", profile(shm(MIB // 4), used("s")))
    assert "0.2 MiB" in transport_advice(MIB // 3, small, FAST)
    assert transport_advice(DEFAULT_SEGMENT_BYTES, MALLOC, FAST) == ""
    assert "no profile is set" in transport_advice(DEFAULT_SEGMENT_BYTES + 1, MALLOC, FAST)


def test_other_middlewares_read_no_profile() -> None:
    assert transport_advice(64 * MIB, MALLOC, "rmw_cyclonedds_cpp") == ""
    assert "MALLOC" in transport_advice(64 * MIB, {}, "rmw_cyclonedds_cpp")
    assert transport_advice(64 * MIB, {**MALLOC, "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}, FAST) == ""


@pytest.mark.skipif(not os.confstr("CS_GNU_LIBC_VERSION"), reason="malloc of glibc")
@pytest.mark.parametrize(
    ("environment", "named"),
    [
        ({}, list(MALLOC_VARIABLES)),
        ({"MALLOC_TRIM_THRESHOLD_": "536870912"}, ["MALLOC_MMAP_THRESHOLD_"]),
        ({**MALLOC, "MALLOC_MMAP_THRESHOLD_": "131072"}, ["MALLOC_MMAP_THRESHOLD_"]),
        ({**MALLOC, "MALLOC_TRIM_THRESHOLD_": "many"}, ["MALLOC_TRIM_THRESHOLD_"]),
        (MALLOC, []),
        ({"GLIBC_TUNABLES": "glibc.malloc.trim_threshold=1073741824"}, []),
        ({"LD_PRELOAD": "/usr/lib/libjemalloc.so.2"}, []),
    ],
)
def test_malloc_matters_for_large_images(environment: dict[str, str], named: list[str]) -> None:
    environment = {**dict.fromkeys(PROFILE_VARIABLES, str(SHIPPED)), **environment}
    advice = transport_advice(4 * MIB, environment, FAST)
    assert re.findall(r"MALLOC_\w+", advice) == named
    assert transport_advice(MIB - 1, environment, FAST) == ""


BAD = {
    "no file": None,
    "empty": "",
    "no XML": "<profiles",
    "document type": '<!DOCTYPE p [<!ENTITY a "a">]>' + profile(shm(), used("s")),
    "too large": profile(shm(), used("s")) + " " * MIB,
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_profile_is_named(case: str, tmp_path: Path) -> None:
    path, text = tmp_path / "bad.xml", BAD[case]
    if text is not None:
        path.write_text(text, encoding="utf-8")
    environment = dict.fromkeys(PROFILE_VARIABLES, str(path))
    with pytest.raises(ConfigError, match=r"bad\.xml"):
        shared_memory(environment)
    assert "bad.xml" in transport_advice(4 * MIB, environment, FAST)
    assert transport_advice(100_000, environment, FAST) == ""


def test_only_what_the_installed_version_reads_counts(tmp_path: Path) -> None:
    """As seen with both: version 3 warns of the first variable, but it wins."""
    first, second = PROFILE_VARIABLES
    for folder in ("2/share/fastrtps", "3/share/fastdds"):
        (tmp_path / folder).mkdir(parents=True)
    two, three = ({"AMENT_PREFIX_PATH": f"/nowhere{os.pathsep}{tmp_path / v}"} for v in "23")
    both = {first: "/first.xml", second: "/second.xml"}
    for installed in (two, three):
        assert profile_file({**installed, **both}) == (first, Path("/first.xml"))
    assert profile_file({**three, second: "/second.xml"}) == (second, Path("/second.xml"))
    assert profile_file({**two, second: "/second.xml"}) is None
    advice = transport_advice(4 * MIB, {**two, second: str(SHIPPED), **MALLOC}, FAST)
    assert f"{second} is not read" in advice


def test_a_profile_in_the_working_directory_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with_profile(tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml", profile(shm(3 * MIB), used("s")))
    assert shared_memory({}).segment_bytes == 3 * MIB
    assert shared_memory({"SKIP_DEFAULT_XML_FILE": "1"}).segment_bytes == DEFAULT_SEGMENT_BYTES
