"""The TOML profiles that ship with gsbake."""
