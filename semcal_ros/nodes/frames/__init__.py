"""Input of frames with their magnification and calibration; output of images and drift."""
