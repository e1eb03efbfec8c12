"""Automatic detection of the corners of an endless chess board."""

from __future__ import annotations

from semcal_ros.core.corners.detection import LatticeDetection, LatticeStatus, find_lattice

__all__ = ["LatticeDetection", "LatticeStatus", "find_lattice"]
