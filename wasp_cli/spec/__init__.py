"""Text to a frozen model: pydantic models, YAML with positions, presets."""
