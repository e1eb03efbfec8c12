"""The method itself: arrays and seconds in, frozen dataclasses out. No ROS, files, clocks or logging."""
