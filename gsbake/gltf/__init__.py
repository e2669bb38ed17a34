"""The GLB file: writer, tangents, audit."""
