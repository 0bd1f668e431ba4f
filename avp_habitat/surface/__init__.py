"""The scene's surface: points on it, how well each was seen, and maps of that around the agent."""
