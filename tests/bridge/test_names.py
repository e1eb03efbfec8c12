"""Names that ROS accepts."""

from __future__ import annotations

import pytest

from semcal_ros.bridge.names import absolute_namespace
from semcal_ros.core.errors import InvalidValueError


@pytest.mark.parametrize("given", ["sem/left", "/sem/left", "/sem/left/"])
def test_a_namespace_has_one_form(given):
    assert absolute_namespace(given) == "/sem/left"


@pytest.mark.parametrize("given", ["", "/", "a b", "1st", "sem//left", "s\u00e9m"])
def test_what_ros_refuses_is_refused(given):
    with pytest.raises(InvalidValueError, match="namespace"):
        absolute_namespace(given)
