"""MLflow runs whatever the host: nothing slowed down, nothing lost; MLflow itself is imported when it is first used."""
