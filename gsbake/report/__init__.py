"""The report and the renderer behind its figures."""
