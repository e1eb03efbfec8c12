"""The ``semcal`` command."""

from __future__ import annotations

import os

# Before numpy is imported, for the reason given in semcal_ros.nodes.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from semcal_ros.cli.main import main

__all__ = ["main"]
