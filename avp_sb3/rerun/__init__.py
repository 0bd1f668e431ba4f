"""Episodes and rollouts as Rerun recordings."""

APPLICATION = "avp"
"""Application id of all of them, by which a viewer keeps its layout."""
