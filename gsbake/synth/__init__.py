"""The built-in analytic capture with known truth."""
