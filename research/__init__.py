"""Programs that write the project's own pages and figures; not installed.

``python -m research --list`` names the pages, ``python -m research NAME`` writes one, ``make
pages`` all of them. A page and its figures are the only output.
"""
