"""derail_ros: a simulator of train derailments that lives in ROS 2."""

__version__ = "0.1.0"
