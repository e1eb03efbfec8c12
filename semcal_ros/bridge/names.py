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

"""Names of ROS 2 (https://design.ros2.org/articles/topic_and_service_names.html)."""

from __future__ import annotations

from semcal_ros.core.errors import InvalidValueError


def absolute_namespace(namespace: str) -> str:
    """Return a namespace such as ``sem/left/`` in the form ``/sem/left``.

    Raises
    ------
    InvalidValueError
        If ROS would not accept it.
    """
    parts = namespace.strip("/").split("/")
    if not all(part.isascii() and part.isidentifier() for part in parts):
        raise InvalidValueError(f"namespace {namespace!r}", expected="a ROS namespace such as /sem")
    return "/" + "/".join(parts)
