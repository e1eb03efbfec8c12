"""Recordings as rosbag2 bags."""
