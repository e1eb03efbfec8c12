"""From views of a grid to a magnification-continuous calibration with its covariance."""
