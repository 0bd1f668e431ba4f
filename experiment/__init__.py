"""The experiment: all methods trained, collected, reconstructed and compared by one command, on MLflow Projects."""
