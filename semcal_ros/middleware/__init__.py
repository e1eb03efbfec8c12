"""DDS profiles, transport advice and security, for nodes and the doctor alike. No ROS imports."""
