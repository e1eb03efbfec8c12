"""Raw frames to undistorted, drift-free images in one interpolation, and their average."""
