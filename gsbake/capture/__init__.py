"""Photos, masks, cameras and structure from motion."""
