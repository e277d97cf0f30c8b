"""How accurate the estimator is: sections of `benchmark.py accuracy`, one a module.

A section has ``TITLE``, ``run(quick) -> dict`` of plain figures, ``table(result) -> str`` in
Markdown and ``checks(result) -> dict`` of promises and whether they hold.
"""
