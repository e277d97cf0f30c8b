"""What the simulated cameras say on the wire, one dialect a module."""
