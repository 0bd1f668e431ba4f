"""Evaluating policies over fixed episodes, and reporting it."""
