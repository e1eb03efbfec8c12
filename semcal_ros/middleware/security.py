"""What the environment says about DDS security, read as strictly as it is meant."""

from __future__ import annotations

import os
from collections.abc import Mapping

from semcal_ros.core.errors import ConfigError

__all__ = ["check_security"]


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
