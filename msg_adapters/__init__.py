"""Engine state to ROS messages and back: the only place that knows both."""
