"""UV atlas, projection of photos, inpainting, ambient occlusion and the normal map."""
