"""The batched environment, and groups of it in processes."""
