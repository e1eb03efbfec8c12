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

"""YAML that could end the process or fill its memory is refused; what calibrations have passes."""

from __future__ import annotations

import pytest

from semcal_ros.core.errors import CalibrationFileError
from semcal_ros.files.plain_yaml import check_plain_yaml, load_plain_yaml


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        # These many brackets overrun the stack of libyaml's composer, which ends the process.
        (200_000 * "[", "nested more than 32 deep at line 1"),
        ("a: &own\n  - *own\n", "an anchor or alias at line 1"),
        ("a: &x [1]\nb: [*x, *x]\n", "an anchor or alias at line 1"),
        ("a: b: c", "not valid YAML at line 1"),
        ("a: \x01", "not valid YAML"),
    ],
)
def test_yaml_that_no_calibration_has_is_refused(text: str, reason: str) -> None:
    with pytest.raises(CalibrationFileError, match=reason):
        check_plain_yaml(text, "text")


def test_plain_yaml_passes() -> None:
    text = "a: [1, {b: [2.5]}]\nc: '*not an alias'\n"
    assert load_plain_yaml(text, "text") == {"a": [1, {"b": [2.5]}], "c": "*not an alias"}
