"""What the complete calibration makes of imperfect heads: sections of `benchmark.py head`.

The sections are as those of `accuracy`: ``TITLE``, ``run``, ``table`` and ``checks``.
"""
