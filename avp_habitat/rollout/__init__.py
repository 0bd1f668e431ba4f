"""The rollout folder: its format, reading, capturing, writing and drawing."""
