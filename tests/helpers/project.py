"""What the project declares about itself in pyproject.toml."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["NODES", "PYPROJECT", "ROOT"]

ROOT = Path(__file__).resolve().parents[2]
PYPROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
NODES: tuple[str, ...] = tuple(PYPROJECT["project"]["entry-points"]["semcal_ros.nodes"])
"""Names of the ROS executables."""
