"""The page of a live run, for ``derail look`` and ``make run``."""
