"""HTML report of a run, and the renderer that compares the asset with the photos."""
