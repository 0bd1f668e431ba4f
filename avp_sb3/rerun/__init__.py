"""Episodes and rollouts as Rerun recordings."""
