"""How long estimates take, beside other programs on the same inputs, one section a module.

`benchmark.py estimate` runs them. Each has a TITLE, ``run(quick, ...)`` that measures, and `table`
and `checks` of what it found.
"""
