"""From surfels to a clean mesh: distance field, marching cubes, clean-up, decimation."""
