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

"""Configurations: whatever the text, a configuration that can be used or one clear line."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from semcal_ros.bridge.magnification import read_magnification
from semcal_ros.config.config import (
    MicroscopeConfig,
    config_directories,
    find_config_file,
    load_config,
    parse_config,
)
from semcal_ros.core.errors import SemcalError
from tests.helpers.fuzz_inputs import (
    YAML_PIECES,
    alias_bombs,
    damaged,
    edited_text,
    edited_tree,
    odd_texts,
)
from tests.helpers.fuzz_support import attempt, check_refusal, fuzz, run_semcal

_SHIPPED = [
    path.read_text(encoding="utf-8")
    for path in sorted(config_directories()[0].iterdir())
    if path.suffix == ".yaml"
]
_FULL = """\
name: lab
display_width_m: 0.12
frame_id: sem
image: {topic: image_raw, type: sensor_msgs/msg/Image, stamp: end, databar_rows: 3}
magnification:
  quantity: pixel_size
  topic: /sem/state
  type: lab_msgs/msg/State
  field: a.b[1]
  unit: nm
  image_width_px: 1024
scan: {frame_time_s: 0.5, averages: 4, flyback_fraction: 0.1}
squares_m: [25e-6, 10e-6]
"""
_MINIMAL = "name: a\ndisplay_width_m: 0.1\nmagnification: {quantity: magnification}\n"
_TEXTS = [_FULL, _MINIMAL, *_SHIPPED]
_TREES = [json.dumps(yaml.safe_load(text)) for text in _TEXTS]


def _check(config: MicroscopeConfig) -> None:
    """Every number can be used, and a message is read or refused with it."""
    numbers = [config.display_width_m, config.start_offset_s, config.centre_offset_s]
    numbers += [config.magnification.si_per_unit, *config.squares_m]
    assert all(isinstance(number, float) and math.isfinite(number) for number in numbers)
    assert config.display_width_m > 0.0
    assert config.start_offset_s <= 0.0
    assert config.image.databar_rows is None or type(config.image.databar_rows) is int
    assert list(config.squares_m) == sorted(config.squares_m, reverse=True)
    assert json.dumps(asdict(config), allow_nan=False)
    message = SimpleNamespace(data=500.0, a=SimpleNamespace(b=[1.0, 2.0]))
    try:
        assert read_magnification(message, config).magnification(512) >= 1.0
    except SemcalError as error:
        check_refusal(error)


def _parsed(text: str) -> MicroscopeConfig:
    config = parse_config(text)
    _check(config)
    assert parse_config(text) == config
    return config


def test_the_valid_files_are_accepted() -> None:
    for text in _TEXTS:
        assert attempt(lambda text=text: _parsed(text)) is not None


@fuzz(2.0)
@given(text=edited_text(_TEXTS, YAML_PIECES))
@example(text="a: !!timestamp x")
@example(text='a: !!int ""')
@example(text="a: !!bool maybe")
@example(text="!!set [x, x]")
@example(text='a: "\\UFFFFFFFF"')
@example(text="a" * 2000 + ": 1")
@example(text="name: 0x" + "f" * 5000)
@example(text="[" * 200_000)
@example(text=_MINIMAL + f"scan: {{frame_time_s: 1.0, averages: {10**400}}}\n")
@example(text=_MINIMAL.replace("}", f', field: "a[{"9" * 5000}]"}}'))
def test_edited_text(text: str) -> None:
    attempt(lambda: _parsed(text))


@fuzz(1.5)
@given(tree=edited_tree(_TREES))
def test_edited_values(tree: Any) -> None:
    text = yaml.dump(tree, sort_keys=False)
    attempt(lambda: _parsed(text))


@fuzz(0.5)
@given(text=alias_bombs(_MINIMAL.replace("0.1", "{}")))
def test_texts_that_stand_for_much_more(text: str) -> None:
    assert attempt(lambda: _parsed(text)) is None


@fuzz()
@given(data=damaged([text.encode() for text in _TEXTS]))
def test_damaged_files(folder: Path, data: bytes) -> None:
    path = folder / "config.yaml"
    path.write_bytes(data)

    def load() -> MicroscopeConfig:
        config = load_config(path)
        _check(config)
        return config

    attempt(load)


@fuzz(0.5)
@given(
    name=st.sampled_from(["generic", "jsm820.yaml", "generic.", "GENERIC", "~nobody/x", "generic/"])
    | st.text(alphabet="./\\~$*%a\x00 ", max_size=12)
    | odd_texts
)
def test_names(name: str) -> None:
    found = attempt(lambda: find_config_file(name))
    assert found is None or found.is_file()


@fuzz(0.3)
@given(text=edited_text(_TEXTS, YAML_PIECES))
def test_the_command_line(folder: Path, capfd: pytest.CaptureFixture[str], text: str) -> None:
    """The first thing that a command does is to read the configuration; then there is no recording."""
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    missing = folder / "no_recording"
    assert attempt(lambda: run_semcal(capfd, "info", missing, "--config", path)) is None
