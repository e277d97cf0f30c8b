"""Axis cameras (VAPIX)."""
