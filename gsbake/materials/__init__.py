"""Base colour, roughness, metallic, emission and light fitted to photos in texture space."""
