"""Many runs: ensembles, validation and the measures taken of them; needs no ROS."""
