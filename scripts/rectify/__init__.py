"""How fast pictures are rectified, beside other programs on the same pictures.

`benchmark.py rectify` runs the sections, one a module. Each has a TITLE, ``run(quick, ...)`` that
measures, and `table` and `checks` of what it found.
"""
