"""The scan camera: projection and distortion, and parameters as functions of the magnification."""
