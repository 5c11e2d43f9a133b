"""The terms that all rooms share: parameters, results, and the interface of a run.

Nothing here imports another room.
"""
