"""Bending of a cantilever."""
