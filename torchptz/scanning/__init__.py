"""The virtual pattern: where to point the head, and what to find in its pictures."""
