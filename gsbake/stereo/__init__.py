"""Multi-view PatchMatch stereo: a plane per pixel, matched where photos can be matched, fused into oriented points."""
