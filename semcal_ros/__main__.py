"""``python -m semcal_ros`` is the ``semcal`` command."""

from __future__ import annotations

import sys

from semcal_ros.cli import main

__all__: list[str] = []

sys.exit(main())
