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

"""What the environment says about DDS security, read as strictly as it is meant."""

from __future__ import annotations

import os
from collections.abc import Mapping

from semcal_ros.core.errors import ConfigError


def check_security(environment: Mapping[str, str] = os.environ) -> None:
    """Refuse settings that ROS would take as no security at all, without a word.

    Raises
    ------
    ConfigError
        ``ROS_SECURITY_ENABLE`` or ``ROS_SECURITY_STRATEGY`` is misspelt, or there is no keystore.
    """
    enabled = _one_of(environment, "ROS_SECURITY_ENABLE", "true", "false")
    strategy = _one_of(environment, "ROS_SECURITY_STRATEGY", "Enforce", "Permissive")
    if (enabled, strategy) == ("true", "Enforce") and not environment.get("ROS_SECURITY_KEYSTORE"):
        raise ConfigError(
            "ROS_SECURITY_KEYSTORE is not set",
            expected="the folder of a keystore, because security is enforced",
            do="see doc/security.md",
        )


def _one_of(environment: Mapping[str, str], name: str, *accepted: str) -> str:
    value = environment.get(name, "")
    if value and value not in accepted:
        raise ConfigError(
            f"{name} is {value!r}",
            expected=" or ".join(accepted),
            do="ROS would run this node without security",
        )
    return value
