"""What becomes of a camera with which something is wrong: sections of `benchmark.py faults`.

The sections are as those of `accuracy`: ``TITLE``, ``run``, ``table`` and ``checks``.
"""
