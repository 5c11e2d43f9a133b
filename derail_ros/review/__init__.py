"""Pictures and summaries of finished runs, without ROS."""
