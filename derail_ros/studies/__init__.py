"""Many runs: ensembles, studies, validation and their statistics, without ROS."""
