"""Inputs, outputs and parameters of the visual servo."""
