"""Raw frames to rectified, drift-free images in one interpolation, and their average."""
