"""Calibration methods and the corner finder beside others, and whether stated uncertainties hold."""
