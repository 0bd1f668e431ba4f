"""The baseline `nbv`: next-best-view planning on an occupancy grid of what the agent's own depth has shown."""
