"""Live view of a run: one page on loopback with the present render, curves, decisions and the time left."""
