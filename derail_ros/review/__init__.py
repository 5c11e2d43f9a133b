"""Pictures and measures made of finished runs; needs no ROS."""
