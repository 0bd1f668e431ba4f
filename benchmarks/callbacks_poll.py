"""Watches a running training's points appear in MLflow from a process of its own; started by callbacks.py."""

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from avp_habitat import command

_METRIC = "time/total_timesteps"
_PAUSE_S = 0.05


def main(argv: Sequence[str]) -> None:
    """Print a line when it watches, and at the end the seconds from each point's logging to its finding.

    Args:
        argv: tracking address, experiment, and the file whose appearance ends the watch.
    """
    from mlflow import MlflowClient

    address, experiment, stop = argv
    client, delays, run = MlflowClient(address), {}, None
    client.search_experiments(max_results=1)
    print("ready", flush=True)
    while not Path(stop).exists():
        found = client.get_experiment_by_name(experiment)
        runs = client.search_runs([found.experiment_id]) if found and run is None else []
        run = runs[0].info.run_id if runs else run
        points = client.get_metric_history(run, _METRIC) if run else []
        now = time.time()
        for point in points:
            delays.setdefault(point.step, now - point.timestamp / 1000)
        time.sleep(_PAUSE_S)
    print(json.dumps(list(delays.values())))


if __name__ == "__main__":
    sys.exit(command.run(main))
