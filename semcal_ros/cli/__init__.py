"""The ``semcal`` command."""

from __future__ import annotations

from semcal_ros.cli.main import main

__all__ = ["main"]
