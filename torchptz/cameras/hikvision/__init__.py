"""Hikvision cameras and their rebrands (ISAPI)."""
