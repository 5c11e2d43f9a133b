"""Predictions of accidents with bands, and how they are learned."""
