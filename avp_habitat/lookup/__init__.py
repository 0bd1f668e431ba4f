"""Tables of a scene that answer what a view observes without casting its rays."""
