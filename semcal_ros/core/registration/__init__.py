"""The sub-pixel shift between two images, or the reason why there is none."""
