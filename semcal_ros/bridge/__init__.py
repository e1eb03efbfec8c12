"""ROS messages to and from values of :mod:`semcal_ros.core`, and the ``msg_configs`` files that say
where they are.

Nothing here imports ROS: functions look at attribute names only and serve messages of rclpy and of
rosbags alike.
"""
