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

"""Names that ROS accepts."""

from __future__ import annotations

import pytest

from semcal_ros.bridge.fields import absolute_namespace
from semcal_ros.core.errors import InvalidValueError


@pytest.mark.parametrize("given", ["sem/left", "/sem/left", "/sem/left/"])
def test_a_namespace_has_one_form(given):
    assert absolute_namespace(given) == "/sem/left"


@pytest.mark.parametrize("given", ["", "/", "a b", "1st", "sem//left", "s\u00e9m"])
def test_what_ros_refuses_is_refused(given):
    with pytest.raises(InvalidValueError, match="namespace"):
        absolute_namespace(given)
