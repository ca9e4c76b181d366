"""A ROS 2 node around TriLiteNet: ``messages`` fills standard messages, ``node`` is the wiring."""
