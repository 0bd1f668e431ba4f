"""The experiment: all methods trained, collected, reconstructed and compared by one command, on MLflow Projects."""

import importlib.util
import sys

# `mlflow run` takes the `python` of the path, which is not that of its own environment unless that one is activated.
if importlib.util.find_spec("gymnasium") is None:
    sys.exit(f"error: {sys.executable} has not got the suite's packages; first: source .venv/bin/activate")
