"""Known poses in all supported formats, and normalisation to the unit frame."""
