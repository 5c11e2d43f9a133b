"""What everything here speaks of: parameters in, results out, and what a run is; imports nothing else."""
