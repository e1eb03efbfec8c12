"""The ROS 2 executables: thin nodes around :mod:`semcal_ros.core` and :mod:`semcal_ros.bridge`."""

from __future__ import annotations

import os

__all__: list[str] = []

# Before numpy is imported. The matrices here are small, and OpenBLAS's threads wait for each other
# in busy loops: beside other nodes that costs several times the work itself.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
