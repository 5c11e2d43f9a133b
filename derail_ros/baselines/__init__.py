"""Earlier, simpler models, for comparison with the main one."""
