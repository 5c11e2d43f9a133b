"""How many cars, how sure: predictions of accidents, and what they are learned from."""
