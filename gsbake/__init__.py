"""gsbake: photos in, relightable game-ready asset out."""

__version__ = "0.1.0"
