"""Multi-view stereo: PatchMatch, geometric consistency, fusion, carving of the visual hull."""
