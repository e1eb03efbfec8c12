"""Imports that warn for reasons of their own."""

from __future__ import annotations

import warnings

# rclpy imports a parser whose dependency uses modules that Python 3.11 deprecates; only the import is excused.
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import rosidl_generator_py  # noqa: F401
