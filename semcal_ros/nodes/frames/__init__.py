"""Frames in, with their magnification and calibration; images and drift out."""
