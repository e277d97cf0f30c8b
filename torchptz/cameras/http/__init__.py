"""HTTP to a camera: login, encryption, limits, and replies that may be anything."""
