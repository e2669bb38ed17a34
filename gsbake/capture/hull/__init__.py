"""The visual hull of the masks."""
