"""ROS 2 nodes: thin ones, over modules that know no ROS and hold no physics."""
