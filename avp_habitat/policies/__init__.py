"""Policies by name: reactive, frontier, greedy, planners with full knowledge, and saved models."""
