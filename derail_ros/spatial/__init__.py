"""The engine in three dimensions: the same scenarios, moved by MuJoCo."""
