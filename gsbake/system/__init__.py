"""What Linux, macOS and Windows do differently: processes, pipes, limits, the disk, names of files. Everything else in gsbake uses this
folder, which imports nothing of gsbake.

What one system lacks is looked up by its name, not by the system's, and left out or replaced where it is not found: so the tests run the
other ways on Linux too, by taking `resource`, `prctl` and process groups away.
"""
