"""What a camera sees: the in-image rule, visibility of floor cells and points, and tables that replace rays."""
