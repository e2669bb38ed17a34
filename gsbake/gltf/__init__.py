"""Asset export: GLB reader and writer, 8-bit textures, asset frame, audit."""
