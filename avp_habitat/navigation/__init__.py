"""Where agents can stand and how they move, from a triangle mesh."""
