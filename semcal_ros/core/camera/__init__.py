"""The scan camera: projection, distortion, and their parameters as functions of the magnification."""
