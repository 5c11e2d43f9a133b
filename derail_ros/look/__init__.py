"""A run as it goes, on a page served to a browser: ``derail look``, and beside ``make run``."""
