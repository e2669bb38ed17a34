"""Settings: the pydantic schema, TOML profiles and overrides."""
