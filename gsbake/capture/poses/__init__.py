"""Known poses in all formats that are read, and the frame that all later steps work in."""
