"""The ROS 2 executables: thin nodes around :mod:`semcal_ros.core` and :mod:`semcal_ros.bridge`."""
