"""The words that every room shares: parameters in, results out, and what a run is.

Nothing here imports another room.
"""
